"""The reference, from docstrings: pages of the API, and what the page of each method ends with."""

from typing import Any

from mkdocs.structure.files import File, Files

from iflow_gym.baselines.registry import METHODS, load_method
from iflow_gym.system import DynamicalSystem, Method

API = {
    "demonstrations": ("Demonstrations", "Recordings of a motion: what every method learns from."),
    "contract": ("Methods", "What every method keeps, and how it becomes a policy."),
    "environments": ("Environments", "The classes behind the ids, for one process and batched."),
    "metrics": ("Metrics", "Pure functions of arrays, each with its equation and its source."),
    "evaluation": ("Evaluation", "Scores, records, and what many of them say together."),
    "residual": ("Residuals", "Corrections on top of a learned motion, with a shield."),
    "classification": ("Classification", "Which motion a trajectory is."),
    "plotting": ("Plotting", "Pictures of fields, and figures that compare methods."),
}
"""Page to its title and what is on it."""

MODULES = {
    "demonstrations": (
        "iflow_gym.demonstrations",
        "iflow_gym.demonstration_files",
        "iflow_gym.datasets.lasa",
        "iflow_gym.datasets.letters",
        "iflow_gym.datasets.drums",
        "iflow_gym.datasets.recorded",
        "iflow_gym.rounds",
        "iflow_gym.phases",
    ),
    "contract": (
        "iflow_gym.system",
        "iflow_gym.primitive",
        "iflow_gym.policy",
        "iflow_gym.partial_fits",
        "iflow_gym.model_files",
        "iflow_gym.saved_models",
        "iflow_gym.fit_records",
        "iflow_gym.baselines.registry",
    ),
    "environments": (
        "iflow_gym.registration",
        "iflow_gym.envs.point_mass",
        "iflow_gym.envs.point_mass_vector",
        "iflow_gym.envs.task",
        "iflow_gym.envs.guide",
        "iflow_gym.envs.lasa",
        "iflow_gym.envs.letters",
        "iflow_gym.envs.disturbed",
        "iflow_gym.envs.hit_reward",
        "iflow_gym.envs.drumming.env",
        "iflow_gym.envs.drumming.recorded",
    ),
    "metrics": (
        "iflow_gym.metrics.registry",
        "iflow_gym.metrics.accuracy",
        "iflow_gym.metrics.stability",
        "iflow_gym.metrics.cycles",
        "iflow_gym.metrics.drumming",
        "iflow_gym.metrics.cost",
        "iflow_gym.metrics.aggregate",
    ),
    "evaluation": (
        "iflow_gym.evaluate",
        "iflow_gym.evaluation.rollouts",
        "iflow_gym.results",
        "iflow_gym.statistics",
    ),
    "residual": (
        "iflow_gym.residual.wrapper",
        "iflow_gym.residual.policy",
        "iflow_gym.residual.shield",
        "iflow_gym.residual.bases",
    ),
    "classification": ("iflow_gym.classification",),
    "plotting": (
        "iflow_gym.plotting",
        "iflow_gym.figures",
        "iflow_gym.comparison_figures",
    ),
}
"""Page to the modules on it. A test sees that all modules of the package are somewhere."""

INNER = {
    "iflow_gym.datasets.handwriting",
    "iflow_gym.envs.dynamics",
    "iflow_gym.envs.nearest",
    "iflow_gym.envs.rendering",
    "iflow_gym.residual.composition",
    "iflow_gym.watched_training",
}
"""Modules that nobody needs but those who change the package."""

LONG = ("iflow_gym.metrics.registry",)
"""Modules whose values are too long to be shown."""
LONG_VALUES = "    options: { show_attribute_values: false }\n"

NEEDS = {
    "_step": "a step of its own",
    "_lyapunov": "a Lyapunov function",
    "_log_prob": "a density of transitions",
}
"""What a field may have beside its velocity, by the method that it overrides."""


def overview() -> str:
    """Return the first page of the API."""
    rows = "\n".join(
        f"| [{title}]({page}.md) | {text} | {', '.join(f'`{m}`' for m in MODULES[page])} |"
        for page, (title, text) in API.items()
    )
    return f"""# API

`import iflow_gym` registers the environments and has `Demonstrations`, `DynamicalSystem`,
`MovementPrimitive`, their policies and `load_lasa`. Methods are documented on their own pages.

| page | what is on it | modules |
| --- | --- | --- |
{rows}
"""


def api_page(page: str) -> str:
    """Return a page of the API."""
    title, text = API[page]
    blocks = (f"::: {name}\n{LONG_VALUES if name in LONG else ''}" for name in MODULES[page])
    return f"# {title}\n\n{text}\n\n" + "\n".join(blocks)


def method_reference(name: str) -> str:
    """Return what is appended to a method's page: facts of the class, its settings, its members."""
    method: type[Method] = load_method(name)
    learned = [
        text
        for text, learns in (("end", method.learns_goals), ("repeat", method.learns_cycles))
        if learns
    ]
    has = [
        text
        for attribute, text in NEEDS.items()
        if issubclass(method, DynamicalSystem)
        and getattr(method, attribute) is not getattr(DynamicalSystem, attribute)
    ]
    facts = {
        "name on the command line": f"`{name}`",
        "learns motions that": " and ".join(learned),
        "its command depends on": "state and time" if method.uses_time else "the state alone",
        "the seed changes the fit": "yes" if method.stochastic_fit else "no",
        "has": ", ".join(has) or "–",
        "next state": method.integrator,
    }
    rows = "\n".join(f"| {key} | {value} |" for key, value in facts.items())
    options = "    options: { show_root_full_path: false, heading_level: 3 }\n"
    return f"""

## Reference

| `{method.__name__}` | |
| --- | --- |
{rows}

::: {_path(method)}
{options}
::: {_path(method.Config)}
{options}"""


def _path(cls: type[Any]) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"


def on_config(config: Any, **_: Any) -> Any:
    """Put the pages of the API where the navigation says "@reference"."""
    pages = [{title: f"reference/{page}.md"} for page, (title, _) in API.items()]
    entries = [{"Overview": "reference/index.md"}, *pages]
    config.nav = [
        {title: entries if entry == "@reference" else entry for title, entry in part.items()}
        for part in config.nav
    ]
    return config


def on_files(files: Files, config: Any, **_: Any) -> Files:
    """Add the pages of the API."""
    pages = {"reference/index.md": overview()}
    pages |= {f"reference/{page}.md": api_page(page) for page in API}
    for place, content in pages.items():
        files.append(File.generated(config, place, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Append its reference to the page of a method."""
    folder, _, name = page.file.src_uri.removesuffix(".md").rpartition("/")
    if folder == "methods" and name in METHODS:
        return markdown + method_reference(name)
    return markdown
