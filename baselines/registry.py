"""Every method by name: adding one is its file, a line here, and a preset.

Methods are named by strings and imported when asked for, so that listing them costs nothing, and so
that anyone's own class runs in their place: ``"my_package.module:MyClass"``.
"""

from __future__ import annotations

import difflib
import inspect
from importlib import import_module
from typing import TYPE_CHECKING, Any

from iflow_gym.primitive import MovementPrimitive
from iflow_gym.system import DynamicalSystem, Method

if TYPE_CHECKING:
    from iflow_gym.baselines.references import Reference

METHODS = {
    "imitation-flow": "iflow_gym.baselines.imitation_flow:ImitationFlow",
    "seds": "iflow_gym.baselines.seds:SEDS",
    "clf-dm": "iflow_gym.baselines.clf_dm:CLFDM",
    "linear": "iflow_gym.baselines.linear:StableLinear",
    "gmr": "iflow_gym.baselines.gmr:GMR",
    "gpr": "iflow_gym.baselines.gpr:GPR",
    "lwr": "iflow_gym.baselines.lwr:LWR",
    "bc": "iflow_gym.baselines.behavioural_cloning:BehaviouralCloning",
    "dmp": "iflow_gym.baselines.dmp:DMP",
    "promp": "iflow_gym.baselines.promp:ProMP",
    "kmp": "iflow_gym.baselines.kmp:KMP",
    "orbit-field": "iflow_gym.baselines.orbit_field:OrbitField",
}
"""Name to ``module:Class`` of every method, a `Method` whose `name` is the key."""

KINDS = (DynamicalSystem, MovementPrimitive)
"""What a method is one of."""

REFERENCES = {
    "nearest-demonstration": "iflow_gym.baselines.references:NearestDemonstration",
    "replay": "iflow_gym.baselines.references:Replay",
}
"""Name to ``module:Class`` of the rows that are no competitors."""


class UnknownNameError(ValueError):
    """A name that was asked for is none, or is not what it should be."""


def load_method(name: str) -> type[Method]:
    """Return the class of a registered method, or of any ``"module:Class"``.

    Raises
    ------
    UnknownNameError
        If there is none, with the nearest names; if the module or the class is missing; or if the
        class is no `DynamicalSystem` or `MovementPrimitive`, or an abstract one.
    """
    loaded = load_class(name, METHODS)
    if not (inspect.isclass(loaded) and issubclass(loaded, KINDS)):
        raise UnknownNameError(
            f"Expected {name} to be a subclass of iflow_gym.system.DynamicalSystem or of "
            f"iflow_gym.primitive.MovementPrimitive, got {loaded!r}."
        )
    if missing := sorted(getattr(loaded, "__abstractmethods__", ())):
        raise UnknownNameError(f"Expected {name} to implement {missing}, got an abstract class.")
    if absent := [a for a in ("name", "title", "Config") if not hasattr(loaded, a)]:
        raise UnknownNameError(f"Expected {name} to have the class attributes {absent}, got none.")
    return loaded


def load_reference(name: str) -> type[Reference]:
    """Return the class of a reference row."""
    loaded: type[Reference] = load_class(name, REFERENCES)
    return loaded


def load_class(name: str, table: dict[str, str]) -> Any:
    """Return what a name in a table, or a ``"module:Class"``, stands for."""
    target = table.get(name, name)
    module_name, colon, class_name = target.partition(":")
    if not colon:
        raise unknown("method", name, table)
    try:
        module = import_module(module_name)
    except ModuleNotFoundError as error:
        raise UnknownNameError(
            f"Expected {target!r} to be importable, got {error}: install it, or put its folder on "
            "PYTHONPATH."
        ) from error
    if not hasattr(module, class_name):
        near = difflib.get_close_matches(class_name, vars(module), n=1)
        hint = f" Did you mean {module_name}:{near[0]}?" if near else ""
        raise UnknownNameError(f"Expected {module_name} to have {class_name!r}, got none.{hint}")
    return getattr(module, class_name)


def unknown(kind: str, name: str, known: Any) -> UnknownNameError:
    """Return the error for a name that is not among the known ones, with the nearest of them."""
    lowered = {str(k).lower(): str(k) for k in known}
    near = difflib.get_close_matches(name.lower(), lowered, n=3, cutoff=0.4)
    near += [k for k in lowered if name.lower() in k and k not in near][:3]
    hint = f" Did you mean {', '.join(lowered[n] for n in near)}?" if near else ""
    return UnknownNameError(f"Unknown {kind} {name!r}.{hint} Known: {', '.join(sorted(known))}.")
