"""Writes the pages that are made of code: `python docs/generate.py`.

docs/environments.md and a page for each family of environments from their docstrings,
docs/metrics.md from the registry of metrics, the tables in the README and on the pages of drumming
and of residuals from the committed records. A test compares the pages with what this would write.
"""

import inspect
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from iflow_gym.datasets.lasa import MULTI_MODELS, SINGLE_MOTIONS
from iflow_gym.datasets.letters import LETTERS
from iflow_gym.demonstrations import PROTOCOLS
from iflow_gym.envs.disturbed import DisturbedEnv, DisturbedLASAEnv, Wind
from iflow_gym.envs.drumming.env import DrummingEnv
from iflow_gym.envs.drumming.recorded import DrummingRecordedEnv
from iflow_gym.envs.lasa import LASAEnv
from iflow_gym.envs.letters import LetterEnv, LetterRecordedEnv
from iflow_gym.envs.point_mass import PointMassEnv
from iflow_gym.metrics import METRICS, aggregate_scores
from iflow_gym.registration import (
    DRUMMING_ID,
    DRUMMING_RECORDED_ID,
    POINT_MASS_ID,
    disturbed_id,
    lasa_id,
    letter_id,
)
from iflow_gym.results import Result, read_result, read_results, result_path

DOCS = Path(__file__).parent

OF = {
    ("goal", "cycle", "drumming"): "all",
    ("goal",): "that end",
    ("cycle", "drumming"): "that repeat",
    ("drumming",): "of drumming",
}
"""Kinds of motion, in words."""


@dataclass(frozen=True)
class Family:
    """Environments of one class, with a page of their own."""

    page: str
    """Name of the page in docs/environments."""
    ids: str
    """Their id, with what differs in angle brackets."""
    words: str
    """What they are, for the overview."""
    environment: type[Any]
    """Class whose docstring is the page."""
    picture: str
    """File in docs/images."""
    shows: str
    """What the picture shows, for those who do not see it."""
    caption: str = ""
    """What is to be said below it."""
    members: tuple[str, ...] = ()
    """Ids; none where the docstring or the overview has it."""
    facts: bool = False
    """Whether the demonstrations of each are told in a table: they come with the package."""
    example: str = ""
    """How one is made; by default by the first id alone."""
    more: str = ""
    """What follows the docstring."""


SHAPES = (*SINGLE_MOTIONS, *MULTI_MODELS)


def within(entry: type) -> str:
    """Return a class's docstring as a part of a page that is another's, its headings lower."""
    return re.sub(r"^#", "##", inspect.getdoc(entry) or "", flags=re.MULTILINE)


FAMILIES = (
    Family(
        "point-mass",
        POINT_MASS_ID,
        "your own recordings, in any number of dimensions",
        PointMassEnv,
        "environment.png",
        "A frame: stream lines of a policy, the recordings, the mass",
        '`gym.make(..., policy=system, render_mode="rgb_array")`: the stream lines of `system`, '
        "deeper where it is faster, the recordings, and the mass on its way.",
        example=f'gym.make("{POINT_MASS_ID}", demonstrations=Demonstrations.from_arrays(...))',
        more="[Your own data](../your-own-data.md) says how recordings become `Demonstrations`.",
    ),
    Family(
        "lasa",
        "iflow/LASA-<Shape>-v0",
        "30 handwriting motions that end at a goal",
        LASAEnv,
        "lasa.png",
        "The seven recordings of each of the thirty shapes, ending at a star",
        "Rings are where recordings begin, stars where they end. The last four hold two or three "
        "motions each.",
        tuple(map(lasa_id, SHAPES)),
        facts=True,
    ),
    Family(
        "letter",
        "iflow/Letter-<Letter>-v0",
        "four letters traced round and round, by a model of handwriting",
        LetterEnv,
        "letters.png",
        "The suite's letters beside recorded ones",
        members=tuple(letter_id(letter) for letter in LETTERS),
        facts=True,
        more="[How the letters are made](../letters.md), and how they compare with recorded ones. "
        "`iflow_gym.classification.TrajectoryClassifier` tells which letter a recording shows, by "
        "one fitted model of each; the leaderboard has how often it is right.",
    ),
    Family(
        "letter-recorded",
        "iflow/LetterRecorded-<Letter>-v0",
        "the letters that ImitationFlow's authors recorded",
        LetterRecordedEnv,
        "letters-recorded.png",
        "The recordings of I, R, O and S",
        members=tuple(letter_id(letter, recorded=True) for letter in LETTERS),
        more="[The recorded letters](../letters.md#the-recorded-letters-and-the-drumming): where "
        "they come from, and how to use them without a network.",
    ),
    Family(
        "disturbed",
        "iflow/Disturbed-<Shape>-v0",
        "a LASA shape, a plant of unknown mass, and wind",
        DisturbedLASAEnv,
        "disturbed.png",
        "Paths on the nominal plant, and on the disturbed one, where they are late and stop short",
        "The same ImitationFlow commands both plants, for as long as each recording lasts. The one "
        "on the right is heavier than its controller is told and lags behind, in the wind of the "
        "arrows: the motion is late.",
        tuple(map(disturbed_id, SHAPES)),
        more=f"""With your own recordings: `iflow_gym.envs.disturbed.DisturbedEnv(demonstrations)`.
[Residuals on a learned motion](../residual.md) are what it is for.

## The plant

{within(DisturbedEnv)}

## Wind

{within(Wind)}

By default `strength` is {Wind.strength}, `curl` {Wind.curl}, `reach` {Wind.reach} and `direction`
{tuple(Wind().unit(2).tolist())}.""",
    ),
    Family(
        "drumming",
        DRUMMING_ID,
        "an arm in MuJoCo that drums",
        DrummingEnv,
        "drumming.gif",
        "The arm plays one round",
        "A demonstration replayed: over a high arch to the right drum, over a low one to the left. "
        "A head that is hit turns yellow; the blue line is the tip's way in the last 0.6 s.",
        more="[Drumming](../drumming.md): an example, what the scores mean, and what is learned.",
    ),
    Family(
        "drumming-recorded",
        DRUMMING_RECORDED_ID,
        "the same arm, and the recording of ImitationFlow's authors",
        DrummingRecordedEnv,
        "drumming-recorded.png",
        "Six recordings in space, over two drums, and how high the tip is over time",
        "The recordings, shifted into the arm's workspace, and the drums set under their strokes.",
    ),
)
"""Every registered id is of one of them: a test sees that."""


def environments() -> str:
    """Return the page that leads to the families."""
    rows = "\n".join(f"| [`{f.ids}`](environments/{f.page}.md) | {f.words} |" for f in FAMILIES)
    return f"""# Environments

![A frame: stream lines of a policy, the recordings, the mass](images/environment.png)

*`gym.make("iflow/LASA-Sshape-v0", policy=system, render_mode="rgb_array")`: the stream lines of
`system`, deeper where it is faster, the recordings, and the mass on its way.*

| id | |
| --- | --- |
{rows}

`import iflow_gym` registers the environments. `"iflow_gym:iflow/LASA-Angle-v0"` imports it by
itself, in another process for instance. Rendering needs no OpenGL, but for the drumming arm.

The batched version gives the bits that the single one gives:
`gym.make_vec(id, num_envs=1024, vectorization_mode="vector_entry_point")`. Point masses are stepped
all at once in NumPy; arms, one after the other, in as many processes as there are processors.

All have the demonstrations, a dataset of transitions and a score built in, on the unwrapped
environment: `demonstrations`, `get_dataset(split)` and `score(system, seed=0)`. To add one, see
[adding an environment](adding-an-environment.md).
"""


def facts(ids: Sequence[str]) -> str:
    """Return a table of the demonstrations of environments."""
    rows = []
    for env_id in ids:
        demos = gymnasium.make(env_id).unwrapped.demonstrations
        samples = sorted({len(p) for p in demos.positions})
        counts = "–".join(dict.fromkeys(str(n) for n in (samples[0], samples[-1])))
        size = " × ".join(
            f"{side:.0f}" for side in demos.bounding_box.high - demos.bounding_box.low
        )
        peak = max(float(np.linalg.norm(v, axis=1).max()) for v in demos.velocities)
        cells = (f"{demos.durations.mean():.3g}", size, f"{peak:.1f}")
        rows.append(" | ".join([f"| `{env_id}`", str(len(demos)), counts, *cells]) + " |")
    unit = demos.length_unit
    head = f"| id | recordings | samples | duration (s) | size ({unit}) | peak speed ({unit}/s) |"
    rule = "| --- | ---: | ---: | ---: | ---: | ---: |"
    return "\n".join([head, rule, *rows])


def family_page(family: Family) -> str:
    """Return the page of a family of environments."""
    example = family.example or f'gym.make("{(family.members or (family.ids,))[0]}")'
    parts = [
        f"# `{family.ids}`",
        f"![{family.shows}](../images/{family.picture})",
        f"*{family.caption}*" if family.caption else "",
        f"`{example}`",
        inspect.getdoc(family.environment) or "",
        family.more,
    ]
    if family.members:
        listed = "\n".join(f"- `{env_id}`" for env_id in family.members)
        parts += ["## Ids", facts(family.members) if family.facts else listed]
    text = "\n\n".join(part for part in parts if part)
    # Headings of a docstring stand on their own; tables and text are to be apart from them.
    return re.sub(r"^(#+ .*)\n(?=[^\n#])", r"\1\n\n", text, flags=re.M) + "\n"


def drumming() -> str:
    """Return the page of the drumming arm with its tables filled in."""
    rows = "\n".join(
        f"| `{m.name}` | {m.definition} |" for m in METRICS if m.motions == ("drumming",)
    )
    of_metrics = f"| name | what it is |\n| --- | --- |\n{rows}"
    text = (DOCS / "drumming.md").read_text()
    return filled(filled(text, "metrics", of_metrics), "results", _drumming_scores())


def _cell(text: str) -> str:
    """Return text for a cell of a table."""
    return text.replace("|", r"\|")


def metrics() -> str:
    """Return the page of the metrics."""
    tables = ""
    for family in ("accuracy", "stability", "cost"):
        rows = "\n".join(
            f"| `{m.name}` | {_cell(m.definition)} | {m.unit} | {m.better} | {OF[m.motions]} |"
            for m in METRICS
            if m.family == family
        )
        tables += f"""
## {family.capitalize()}

| name | definition | unit | better | of motions |
| --- | --- | --- | --- | --- |
{rows}
"""
    return f"""# Metrics

Every metric is a pure function of arrays in `iflow_gym.metrics`, whose docstring has its equation,
its source and what happens at the edges. Every result record carries a hash of their code.

The environment is the judge: trajectories are recorded from the environment while it is stepped
with a policy's commands, each held for one dt; a system's own integration is never scored.

**Protocols.** `reproduction` fits on all recordings that are not held out and rolls out from each
one's start. `generalisation` fits on the first four of LASA's seven and scores the other three, of
your own recordings on the first four sevenths; a letter has ten held out, which it scores, and
fits on the other ten. `iflow_gym.evaluate.score(system, env, seed=0, protocol="generalisation")`. A
rollout has its recording's start and dt, and, where the motion ends, its number of samples.

**Stability** is seen from a fixed grid of 16 x 16 starts (7 x 7 x 7 in space, about 256 in other
dimensions) on the recordings' box enlarged by half of each side at every end, over five times the
longest recording, and from the recordings' starts with a push of 25 % of the box's diagonal at 40 %
of the recording. *Converged* means within 2 % of the diagonal of the goal for the whole last 5 % of
that horizon.

**Motions that repeat** are rolled out over eight periods; the last two are the steady orbit, which
is compared with the recording's own samples. Attraction is seen from the same grid of starts: over
the last period a rollout stays within 5 % of the diagonal of the recordings.

**Drumming** adds the hits. `hit_f1` is strict: rounds last a few per cent more or less, and a
policy without a clock cannot know which recording it is to follow, so that one recording played
against another one's score gets 0.18. `rhythm_f1` asks for the rhythm that the recordings have in
common, at any tempo, and `tempo_error` for the tempo.

**Methods that use time** follow a clock and have no field: what is asked of a field (SEDS' error,
direction, velocity, likelihood, Lyapunov function) is null for them, not zero. They converge
because their clock runs out, and are marked and not ranked.

**Guarantees.** `proved`: by construction, for every state. `verified`: checked on a bounded region
with an error bound. `sampled`: seen to hold where it was tried. `none`. Each method states its own,
with the reason.

**Aggregates** are interquartile means and means over environments and seeds with 95 % stratified
bootstrap intervals (10 000 resamples): seeds are resampled within each environment; with one seed
the environments are, and the table says so. A cell that failed is never dropped: it ranks last, and
an aggregate without it says n of N. A mean rank is over the metrics of a board's accuracy table and
over the environments that all ranked methods were run on. A method with which fewer than half of
them would be left has no rank, and the board names it.
{tables}"""


def results() -> str:
    """Return the README's table: means over LASA-26 of the committed records."""
    records = read_results(DOCS.parent / "leaderboard" / "results")
    columns = {
        "rmse": "RMSE (mm)",
        "frechet": "Fréchet (mm)",
        "dtw": "DTW / sample (mm)",
        "converged": "converged",
        "fit_cpu_seconds": "fit (CPU s a shape)",
    }
    text = ""
    for protocol in PROTOCOLS:
        rows = []
        for method in dict.fromkeys(r.method for r in records):
            of_method = [
                r
                for r in records
                if (r.method, r.protocol, r.family) == (method, protocol, "LASA-26")
            ]
            good = [r for r in of_method if r.ok]
            if not good or good[0].reference:
                continue
            values = [[r.metrics[name] for r in good] for name in columns]
            means = [float(np.mean([v for v in column if v is not None])) for column in values]
            kinds = {r.guarantee.kind for r in good if r.guarantee is not None}
            cells = f"{len(good)} of {len(of_method)}"
            shown = [f"{m:.3g}" for m in means]
            all_but = means[3] < 1 and f"{100 * means[3]:.3g}" == "100"
            shown[3] = "> 99.9 %" if all_but else f"{100 * means[3]:.3g} %"
            title = f"{good[0].title} (uses time)" if good[0].uses_time else good[0].title
            line = " | ".join([title, ", ".join(sorted(kinds)), *shown, cells])
            rows.append((means[1], f"| {line} |"))
        head = " | ".join(["", "guarantee", *columns.values(), "cells"])
        rule = " | ".join(["---"] * 2 + ["---:"] * (len(columns) + 1))
        table = "\n".join(row for _, row in sorted(rows))
        text += f"**{protocol.capitalize()}**\n\n|{head} |\n| {rule} |\n{table}\n\n"
    return text.strip()


def readme() -> str:
    """Return the README with its table of results filled in."""
    return filled((DOCS.parent / "README.md").read_text(), "results", results())


def filled(page: str, name: str, text: str) -> str:
    """Return a page with a text between `<!-- name -->` and `<!-- /name -->`."""
    for marker in (f"<!-- {name} -->", f"<!-- /{name} -->"):
        if page.count(marker) != 1:
            raise ValueError(f"Expected {marker} once, got it {page.count(marker)} times.")
    head, rest = page.split(f"<!-- {name} -->")
    _, tail = rest.split(f"<!-- /{name} -->")
    return f"{head}<!-- {name} -->\n{text}\n<!-- /{name} -->{tail}"


RESIDUALS = ("imitation-flow", "imitation-flow+residual", "imitation-flow+stable-residual", "ppo")
"""Rows of the tables of residuals: the base, what is trained on it, learning from scratch."""

Column = tuple[str, Callable[[Result], float | None]]

OF_THE_PLANT: tuple[Column, ...] = (
    ("reward a step", lambda r: r.returns["mean"]),
    ("RMSE (mm)", lambda r: r.metrics["rmse"]),
    ("Fréchet (mm)", lambda r: r.metrics["frechet"]),
    ("DTW / sample (mm)", lambda r: r.metrics["dtw"]),
    ("converged (%)", lambda r: percent(r.metrics["converged"])),
    ("pushed, recovered (%)", lambda r: percent(r.metrics["perturbation_recovery"])),
)
DRUMMING_SCORES = (
    ("`rhythm_f1`", "rhythm_f1", 1.0, 2),
    ("`sequence_f1`", "sequence_f1", 1.0, 2),
    ("`hit_f1`", "hit_f1", 1.0, 2),
    ("`tempo_error`, %", "tempo_error", 100.0, 1),
    ("`period_error`, %", "period_error", 100.0, 1),
    ("`orbit_distance`, mm", "orbit_distance", 1000.0, 0),
    ("`attraction`, 100 starts", "attraction", 1.0, 2),
    ("`perturbation_recovery`", "perturbation_recovery", 1.0, 2),
)
"""Rows of the drumming page's table: heading, metric, factor, decimals."""


def _drumming_scores() -> str:
    """Return what ImitationFlow's records of the arm say, a column a seed."""
    results = DOCS.parent / "leaderboard" / "results"
    seeds = range(3)
    records = [
        read_result(results / result_path("imitation-flow", DRUMMING_ID, "reproduction", seed))
        for seed in seeds
    ]
    lines = ["| | " + " | ".join(f"seed {seed}" for seed in seeds) + " |", "| --- " * 4 + "|"]
    for heading, metric, factor, decimals in DRUMMING_SCORES:
        values = (f"{factor * record.metrics[metric]:.{decimals}f}" for record in records)
        lines.append(f"| {heading} | {' | '.join(values)} |")
    return "\n".join(lines)


OF_DRUMMING: tuple[Column, ...] = (
    ("reward: hits", lambda r: r.returns["hits"]),
    ("reward: progress", lambda r: r.returns["mean"]),
    ("stroke off by (ms)", lambda r: 1000 * r.returns.get("stroke_error", math.nan)),
    ("stroke's force (N)", lambda r: r.returns.get("stroke_force", math.nan)),
    ("rhythm F1", lambda r: r.metrics["rhythm_f1"]),
    ("hit F1", lambda r: r.metrics["hit_f1"]),
    ("period off by (%)", lambda r: percent(r.metrics["period_error"])),
    ("orbit distance (mm)", lambda r: 1000 * (r.metrics["orbit_distance"] or 0.0)),
    ("attraction (%)", lambda r: percent(r.metrics["attraction"])),
    ("pushed, recovered (%)", lambda r: percent(r.metrics["perturbation_recovery"])),
)


def percent(value: float | None) -> float | None:
    """Return a share in per cent."""
    return None if value is None else 100 * value


def residual_table(records: Sequence[Result], columns: Sequence[Column]) -> str:
    """Return a table of one environment: means over the seeds with 95 % bootstrap intervals."""
    budget: tuple[Column, ...] = (
        ("training (CPU s)", lambda r: r.fit["batch_cpu_seconds"] / r.fit["batch_size"]),
        ("environment's share (%)", lambda r: percent(r.fit.get("environment_share"))),
    )
    titles = ["", "seeds", *(title for title, _ in (*columns, *budget))]
    lines = [f"| {' | '.join(titles)} |", f"| --- | {' | '.join(['---:'] * (len(titles) - 1))} |"]
    for method in RESIDUALS:
        rows = sorted((r for r in records if r.method == method), key=lambda r: r.seed)
        if not rows:
            continue
        cells = [rows[0].title, str(len(rows))]
        for _, value in (*columns, *budget):
            found = [value(r) for r in rows]
            numbers = np.array([math.nan if v is None else v for v in found], dtype=np.float64)
            cells.append(with_interval(numbers))
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def with_interval(numbers: np.ndarray[Any, Any]) -> str:
    """Return a mean over seeds and its 95 % interval; a dash where a seed has no value."""
    if not np.isfinite(numbers).all():
        return "-" if not np.isfinite(numbers).any() else "not in every seed"
    if np.ptp(numbers) == 0:
        return f"{numbers[0]:.3g}"
    found = aggregate_scores(numbers[None])
    low, high = found.mean_interval
    return f"{found.mean:.3g} [{low:.3g}, {high:.3g}]"


def residual() -> str:
    """Return the page of residuals with its tables of results filled in."""
    records = read_results(DOCS.parent / "leaderboard" / "results")
    rewarded = [r for r in records if r.method in RESIDUALS and r.ok and r.returns]
    text = ""
    for environment in sorted({r.environment for r in rewarded}):
        here = [r for r in rewarded if r.environment == environment]
        columns = OF_DRUMMING if "Drumming" in environment else OF_THE_PLANT
        text += f"**`{environment}`**\n\n{residual_table(here, columns)}\n\n"
    return filled((DOCS / "residual.md").read_text(), "results", text.strip())


PAGES = {
    "drumming.md": drumming,
    "environments.md": environments,
    "metrics.md": metrics,
    "residual.md": residual,
    "../README.md": readme,
} | {f"environments/{family.page}.md": partial(family_page, family) for family in FAMILIES}

if __name__ == "__main__":
    for name, page in PAGES.items():
        (DOCS / name).write_text(page())
