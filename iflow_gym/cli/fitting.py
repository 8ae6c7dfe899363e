"""``iflow-gym fit``: demonstrations in, a model out."""

from __future__ import annotations

import dataclasses
import difflib
import tomllib
import types
from dataclasses import dataclass
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

from tyro.conf import Positional, UseAppendAction, arg

from iflow_gym.cli.console import (
    PIPE,
    UsageError,
    check_output,
    check_seed,
    output_path,
    print_json,
    progress,
    say,
)
from iflow_gym.cli.helping import field_texts
from iflow_gym.recordings.columns import shown

if TYPE_CHECKING:
    from iflow_gym.system import Method


@dataclass(frozen=True)
class Fit:
    """Learn a motion from demonstrations, and write the model.

    MOTION is a file that `iflow-gym import` wrote, or an environment of `iflow-gym envs` by its id
    or its short name, such as LASA-Angle.

        iflow-gym fit reach.safetensors -o policy.safetensors
        iflow-gym fit LASA-Sshape -o s.safetensors --set n_steps=300 --set n_layers=12
        iflow-gym fit reach.safetensors -o seds.safetensors --method seds --seed 1
        iflow-gym fit reach.safetensors -o mine.safetensors --method my_module:MyMethod

    The model is a safetensors file with a JSON header; nothing in it is executed when it is read.
    """

    motion: Annotated[Positional[str], arg(metavar="MOTION")]
    """What to learn; - reads demonstrations from standard input."""
    output: Annotated[str, arg(metavar="FILE", aliases=["-o"])]
    """Model file to write, such as policy.safetensors; - writes standard output."""
    method: str = "imitation-flow"
    """A registered method (imitation-flow, seds, clf-dm, linear, gmr, gpr, lwr, bc, dmp, promp,
    kmp, orbit-field), or module:Class of one's own, from the current folder for instance."""
    set: Annotated[tuple[str, ...], UseAppendAction, shown("KEY=VALUE")] = ()
    """A setting of the method; may be given several times. `iflow-gym methods imitation-flow`
    lists those of a method."""
    preset: Annotated[str | None, shown("PRESET")] = None
    """Settings of the leaderboard's presets, smoke, standard or full; --set goes over them. By
    default the method's own."""
    seed: int = 0
    """Seed of the fit: the same one gives the same model on the same machine."""
    protocol: Literal["reproduction", "generalisation"] = "reproduction"
    """Which recordings to fit on: all of them, or the first four sevenths, so that `score` can
    take the rest."""
    json: bool = False
    """Print what was fitted as JSON to standard output."""

    def run(self) -> int:
        """Fit."""
        import time

        from iflow_gym.cli.motions import load_method_class, load_motion
        from iflow_gym.fit_records import add_fit_record
        from iflow_gym.watched_training import WatchedGenerator, training_steps

        if self.json and self.output == PIPE:
            raise UsageError("Expected one thing for standard output, got the model and --json.")
        check_output(self.output, self.motion, suffix=".safetensors")
        check_seed(self.seed)
        if self.preset not in (None, "smoke", "standard", "full"):
            raise UsageError(
                f"Expected a preset smoke, standard or full (--preset), got {self.preset!r}."
            )
        cls = load_method_class(self.method)
        method = make_method(cls, self.method, self.preset, self.set)
        demonstrations, _ = load_motion(self.motion)
        demonstrations = demonstrations.split(self.protocol).fit
        with output_path(self.output, ".safetensors") as path:
            wall, cpu = time.perf_counter(), time.process_time()
            steps = training_steps(method, demonstrations)
            with progress(f"Fitting {method.title}", steps, "steps") as told:
                # What is random in a fit is the seed's, and the generator says how far it is.
                seed = self.seed if steps is None else WatchedGenerator(self.seed, told)
                try:
                    method.fit(demonstrations, seed=cast(int, seed))
                except (AssertionError, RuntimeError) as error:  # torch's, of a device that is none
                    raise ValueError(f"{method.title} could not be fitted: {error}") from error
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            method.save(path)
            record = {
                "method": self.method,
                "motion": demonstrations.name,
                "length_unit": demonstrations.length_unit,
                "protocol": self.protocol,
                "recordings": [digest(p) for p in demonstrations.positions],
                "mean_dt": demonstrations.mean_dt,
                "start": demonstrations.starts[0].tolist(),
                "longest": float(demonstrations.durations.max()),
                "seed": self.seed,
                "fit_cpu_seconds": round(cpu, 3),
            }
            add_fit_record(path, record)
        guarantee = method.guarantee
        where = "standard output" if self.output == PIPE else self.output
        say(
            f"{method.title} fitted to {len(demonstrations)} demonstration"
            f"{'s' * (len(demonstrations) > 1)} of {demonstrations.name} in {wall:.1f} s "
            f"({cpu:.1f} s CPU), {method.n_parameters} parameters. Written to {where}."
        )
        say(f"Stability: {guarantee.kind}. {guarantee.reason}")
        if self.json:
            print_json(
                {
                    "output": self.output,
                    "settings": dataclasses.asdict(method.config),
                    "n_parameters": method.n_parameters,
                    "fit_seconds": wall,
                    "guarantee": dataclasses.asdict(guarantee),
                    **record,
                }
            )
        return 0


@dataclass(frozen=True)
class Methods:
    """List the methods, or the settings of one.

    Settings are what `iflow-gym fit` takes by --set.

        iflow-gym methods
        iflow-gym methods imitation-flow
    """

    method: Annotated[Positional[str | None], shown("[METHOD]")] = None
    """A registered method or module:Class whose settings to list."""
    json: bool = False
    """Print JSON."""

    def run(self) -> int:
        """List them."""
        from iflow_gym.baselines.registry import METHODS
        from iflow_gym.cli.motions import load_method_class

        if self.method is None:
            rows: list[dict[str, Any]] = []
            for name in METHODS:
                cls = load_method_class(name)
                learns = [
                    w
                    for w, yes in (("ends", cls.learns_goals), ("repeats", cls.learns_cycles))
                    if yes
                ]
                rows.append(
                    {"name": name, "title": cls.title, "learns": learns, "uses_time": cls.uses_time}
                )
            if self.json:
                print_json(rows)
                return 0
            for row in rows:
                kind = "a motion that " + " or ".join(row["learns"])
                kind += ", by a clock" if row["uses_time"] else ""
                print(f"{row['name']:<16}{row['title']:<24}{kind}")
            return 0
        cls = load_method_class(self.method)
        hints = get_type_hints(cls.Config)
        texts = field_texts(cls.Config)
        fields = [
            {
                "name": f.name,
                "default": getattr(cls.Config(), f.name),
                "type": _type_name(hints[f.name]),
                "text": texts.get(f.name, ""),
            }
            for f in dataclasses.fields(cls.Config)
        ]
        if self.json:
            print_json(fields)
            return 0
        import textwrap

        for entry in fields:
            print(f"{entry['name']} = {_toml(entry['default'])}  ({entry['type']})")
            if entry["text"]:
                print(
                    textwrap.fill(
                        entry["text"], 88, initial_indent="    ", subsequent_indent="    "
                    )
                )
        return 0


def make_method(
    cls: type[Method], name: str, preset: str | None, assignments: tuple[str, ...]
) -> Method:
    """Return an unfitted method with its settings; UsageError says which are wrong."""
    from iflow_gym.baselines.registry import METHODS
    from iflow_gym.baselines.runner.presets import load_settings

    settings: dict[str, Any] = {}
    if preset is not None:
        settings |= load_settings(name, preset, registered=name in METHODS)
    hints = get_type_hints(cls.Config)
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        key = key.strip().replace("-", "_")
        if not equals:
            raise UsageError(f"Expected a setting key=value, got {assignment!r}.")
        if key not in hints:
            near = difflib.get_close_matches(key, hints, n=1)
            hint = f" Did you mean {near[0]}?" if near else ""
            raise UsageError(
                f"Expected a setting of {cls.title}, got {key!r}.{hint} `iflow-gym methods {name}` "
                f"lists them: {', '.join(hints)}."
            )
        settings[key] = _value(text.strip(), hints[key], key)
    try:
        return cls(**settings)
    except (TypeError, ValueError) as error:
        raise UsageError(f"Settings of {cls.title}: {error}") from error


def _value(text: str, hint: Any, key: str) -> Any:
    """Return a setting's value, of its type."""
    if text.lower() in ("none", "null"):
        value: Any = None
    else:
        try:
            value = tomllib.loads(f"v = {text}")["v"]
        except tomllib.TOMLDecodeError:
            value = {"true": True, "false": False}.get(text.lower(), text)
    if isinstance(value, list):
        real = any(get_origin(k) is tuple and get_args(k)[0] is float for k in _types(hint))
        value = tuple(float(v) if real and type(v) is int else v for v in value)
    if float in _types(hint) and type(value) is int:
        value = float(value)
    if not _fits(value, hint):
        raise UsageError(f"Expected {key} to be {_type_name(hint)}, got {text!r}.")
    return value


def _types(hint: Any) -> tuple[Any, ...]:
    """Return the alternatives of a type."""
    if get_origin(hint) in (Union, types.UnionType):
        return tuple(t for part in get_args(hint) for t in _types(part))
    return (hint,)


def _fits(value: Any, hint: Any) -> bool:
    for kind in _types(hint):
        if get_origin(kind) is Literal:
            if value in get_args(kind):
                return True
        elif get_origin(kind) is tuple:
            if isinstance(value, tuple) and all(_fits(v, get_args(kind)[0]) for v in value):
                return True
        elif kind is Any or (isinstance(kind, type) and type(value) is kind):
            return True
    return False


def _type_name(hint: Any) -> str:
    names = []
    for kind in _types(hint):
        if get_origin(kind) is Literal:
            names += [str(choice) for choice in get_args(kind)]
        elif kind is type(None):
            names.append("none")
        elif get_origin(kind) is tuple:
            names.append(f"a list in brackets, each {_type_name(get_args(kind)[0])}")
        else:
            words = {int: "a whole number", float: "a number", bool: "true or false", str: "a word"}
            names.append(words.get(kind, str(kind)))
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"


def _toml(value: Any) -> str:
    if value is None:
        return "none"
    return str(value).lower() if isinstance(value, bool) else str(value)


def digest(positions: Any) -> str:
    """Return a short hash of a recording, by which a score knows it again."""
    import hashlib

    return hashlib.sha256(positions.astype("<f8").tobytes()).hexdigest()[:16]
