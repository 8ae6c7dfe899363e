"""``iflow-gym import``: recordings in, demonstrations out."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from iflow_gym.cli.console import (
    PIPE,
    UsageError,
    check_output,
    check_picture,
    input_bytes,
    output_path,
    print_json,
    save_picture,
    say,
)
from iflow_gym.recordings import CleanUp, Columns
from iflow_gym.recordings.columns import shown
from iflow_gym.recordings.reading import FORMATS


@dataclass(frozen=True)
class Import:
    """Read recordings, clean them, and write a file of demonstrations.

    Reads CSV and other tables of text, JSON lines, NumPy's and MATLAB's files, ROS 2 bags and
    Minari datasets, by their names' endings. What a column is, is guessed by its name. Every step
    of the clean-up is reported on standard error, and can be left out.

    Several files, or a column such as demo (--group), make several demonstrations of one motion.

        iflow-gym import reach.csv -o reach.safetensors --unit mm --to-unit m --plot reach.png
        iflow-gym import take*.csv -o reach.safetensors --align shift --smooth 0.1
        iflow-gym import stir.jsonl -o stir.safetensors --kind cycle
        iflow-gym import pen.mat -o pen.safetensors --positions P --dt 0.01 --no-trim
        iflow-gym import bag_folder -o wipe.safetensors --topic /tool_pose
        cat reach.csv | iflow-gym import - --format csv -o - | iflow-gym fit - -o policy.safetensors
    """

    sources: Annotated[Positional[tuple[str, ...]], shown("FILE...")]
    """Files of recordings, in their order; - reads standard input (with --format)."""
    output: Annotated[str, arg(metavar="FILE", aliases=["-o"])]
    """File of demonstrations to write, such as reach.safetensors, over one that is there already; -
    writes standard output."""
    format: Annotated[str | None, shown("FORMAT")] = None
    """Format of the sources, where names do not tell: csv, npz, jsonl, mat, rosbag, minari."""
    plot: Annotated[str | None, shown("PICTURE")] = None
    """Picture of before and after to write: .png, .svg or .pdf."""
    json: bool = False
    """Print the report as JSON to standard output."""
    columns: OmitArgPrefixes[Columns] = field(default_factory=Columns)
    """What is what in the sources; guessed by the names, where it is not said."""
    clean_up: OmitArgPrefixes[CleanUp] = field(default_factory=CleanUp)
    """What is done to the recordings, in this order."""

    def run(self) -> int:
        """Import."""
        from iflow_gym.demonstration_files import save_demonstrations
        from iflow_gym.recordings import clean, read_recordings
        from iflow_gym.recordings.reading import Source

        if not self.sources:
            raise UsageError("Expected at least one file of recordings, got none.")
        if self.format not in (None, *FORMATS):
            raise UsageError(
                f"Expected a format among {', '.join(FORMATS)} (--format), got {self.format!r}."
            )
        if PIPE in self.sources and self.format is None:
            raise UsageError(
                "Expected the format of what comes on standard input (--format csv, for instance), "
                "got none."
            )
        if PIPE in (self.plot, self.output) and (self.json or self.plot == self.output):
            raise UsageError("Expected one thing for standard output, got several.")
        if self.sources.count(PIPE) > 1:
            raise UsageError("Expected standard input (-) once among the sources, got it again.")
        files = [Path(s).resolve() for s in self.sources if s != PIPE]
        again = [str(f.name) for i, f in enumerate(files) if f in files[:i]]
        if again:
            raise UsageError(
                f"Expected each file of recordings once, got {again[0]} again: every demonstration "
                "counts as one."
            )
        check_output(self.output, *self.sources, suffix=".safetensors")
        if self.plot is not None:
            check_picture(self.plot)
        sources = [
            Source("standard input", content=input_bytes()) if s == PIPE else Source(s, Path(s))
            for s in self.sources
        ]
        options = self.clean_up
        if options.name == CleanUp.name and self.output != PIPE:
            options = replace(options, name=Path(self.output).name.partition(".")[0])
        reading = read_recordings(sources, self.columns, format=self.format)
        named = ", ".join(Path(s.name).name if s.path else s.name for s in sources)
        cleaned = clean(reading, options, source=named)
        for note in cleaned.notes:
            say(str(note))
        with output_path(self.output, ".safetensors") as path:
            save_demonstrations(
                cleaned.demonstrations, path, history=[str(n) for n in cleaned.notes]
            )
        if self.plot is not None:
            from iflow_gym.recordings.picture import cleaning_figure

            save_picture(cleaning_figure(cleaned), self.plot)
        demos = cleaned.demonstrations
        s = "" if len(demos) > 1 else "s"
        ends = (
            f"end{s} at {' '.join(f'{g:.4g}' for g in demos.goal)} {demos.length_unit}"
            if demos.goal is not None
            else f"repeat{s} every {demos.period:.4g} s"
        )
        counts = sorted({len(p) for p in demos.positions})
        samples = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
        say(
            f"{demos.name}: {len(demos)} demonstration{'s' * (len(demos) > 1)} of {samples} "
            f"samples in {demos.n_dims} dimensions, which {ends}. Written to {_named(self.output)}."
        )
        if len(demos) == 1:
            say("One recording alone: nothing shows its spread, and none is left to score unseen.")
        if self.json:
            print_json(
                {
                    "output": self.output,
                    "name": demos.name,
                    "demonstrations": len(demos),
                    "samples": [len(p) for p in demos.positions],
                    "dt": list(demos.dt),
                    "n_dims": demos.n_dims,
                    "unit": demos.length_unit,
                    "goal": None if demos.goal is None else demos.goal.tolist(),
                    "period": demos.period,
                    "sha256": demos.sha256,
                    "report": cleaned.report(),
                }
            )
        return 0


def _named(path: str) -> str:
    return "standard output" if path == PIPE else path
