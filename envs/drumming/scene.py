"""The scene: the Franka arm of gymnasium-robotics, a stick in its hand, two drums.

The arm's model and meshes are read from the installed package, which is not imported (it prints);
nothing of it is copied. Its kinematics, masses and shapes stay as they are. What is changed:

- The fingers are closed on the stick for good, so that seven joints remain.
- The kitchen's heavy joint damping gives way to 1 N m s/rad, and the reflected inertia of the
  motors, which that model leaves out, is 0.1 kg m^2.
- Gravity is compensated, as the real arm does by itself.
- The links touch drums and floor, not each other: the task-space controller stays where they
  could not.
- The meshes that only look good are left out where nothing is drawn: MuJoCo clears a flag for each
  node of each mesh in every physics step, and theirs are 98 % of all.
- Motors take torques; the controller is `iflow_gym.envs.drumming.control`.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np

from iflow_gym.datasets.drums import TIP_RADIUS, Drum
from iflow_gym.demonstrations import FloatArray
from iflow_gym.envs.drumming.engine import mujoco

PHYSICS_DT: Final = 0.001
"""Seconds a physics step."""

TORQUE_LIMITS: Final = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
"""Of the arm's joints, in N m, by the manufacturer's data sheet."""

SPEED_LIMITS: Final = np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61])
"""Of the arm's joints, in rad/s, by the manufacturer's data sheet."""

GRIP: Final = (0.0, 0.0, 0.238)
"""Where the fingers hold the stick, in the frame of the last link."""
STICK_FRONT: Final = 0.28
"""From the grip to the tip, in m."""
STICK_BACK: Final = 0.12
"""From the grip to the butt, in m."""
STICK_RADIUS: Final = 0.007
HAND_PITCH: Final = np.radians(20.0)
"""The hand points down, and this much forward."""
STICK_PITCH: Final = np.radians(20.0)
"""The stick points forward, and this much down."""

HEAD_CONTACT: Final = {"solref": "-300 -25", "solimp": "0.1 0.1 0.001", "friction": "0.4"}
"""Contact of stick and head: a mesh head, which gives way as a spring with a damper. MuJoCo takes
both per inertia; the low impedance leaves the inertia nearly as it is. Pressed by the arm, a head
gives way by 2.2 mm/N (1.6 from 1 cm on, where the stick's neck lies on it too); struck at 0.1 m/s,
it takes about 3 N at once."""

HEAD_DEPTH: Final = 0.05
"""How far a head gives way, in m; there the shell stops the stick."""

CAMERA: Final = (1.80, -1.15, 0.98)
CAMERA_TARGET: Final = (0.38, 0.02, 0.36)

MISSING: Final = (
    "The arm's model ships inside gymnasium-robotics, which was not found: install it with "
    "`pip install gymnasium-robotics`."
)


def assets_folder() -> Path:
    """Return the folder of the arm's model; raise FileNotFoundError where there is none."""
    spec = importlib.util.find_spec("gymnasium_robotics")  # finds the package, does not import it
    for location in (spec.submodule_search_locations or ()) if spec else ():
        folder = Path(location) / "envs" / "assets" / "kitchen_franka" / "franka_assets"
        if (folder / "chain.xml").is_file():
            return folder
    raise FileNotFoundError(MISSING)


@dataclass(frozen=True)
class Scene:
    """A compiled scene and the indices into it; shared, never changed."""

    model: Any
    """mujoco.MjModel"""
    drums: tuple[Drum, ...]
    tip: int
    """Site at the centre of the stick's bead."""
    stick: int
    """Body of the stick."""
    stick_geoms: frozenset[int]
    head_geoms: dict[int, int]
    """Geom of a head -> index of its drum."""
    orientation: FloatArray
    """Rotation matrix of the tip's site that the controller keeps, shape (3, 3)."""
    lower: FloatArray
    upper: FloatArray
    """Joint limits in rad, shape (7,)."""


@lru_cache(maxsize=8)
def load_scene(drums: tuple[Drum, ...]) -> Scene:
    """Compile the scene, once a process for each kit."""
    model = mujoco.MjModel.from_xml_string(scene_xml(drums))
    stick = [model.geom(name).id for name in ("stick:bead", "stick:shaft")]
    ranges = model.jnt_range.copy()
    ranges.setflags(write=False)
    return Scene(
        model=model,
        drums=drums,
        tip=model.site("tip").id,
        stick=model.body("stick").id,
        stick_geoms=frozenset(stick),
        head_geoms=head_geoms(model, drums),
        orientation=np.eye(3),
        lower=ranges[:, 0],
        upper=ranges[:, 1],
    )


def drawn_model(drums: tuple[Drum, ...]) -> Any:
    """Return a mujoco.MjModel of the same scene, with the meshes that are drawn."""
    return mujoco.MjModel.from_xml_string(scene_xml(drums, drawn=True))


def head_geoms(model: Any, drums: Sequence[Drum]) -> dict[int, int]:
    """Return the geom of each head in a model -> the index of its drum."""
    return {model.geom(f"head:{drum.name}").id: i for i, drum in enumerate(drums)}


def scene_xml(drums: Sequence[Drum], *, drawn: bool = False) -> str:
    """Return the scene in MuJoCo's XML, with absolute paths to the arm's meshes.

    The same bodies move in the same way whether or not it is to be `drawn`.
    """
    folder = assets_folder()
    root = ElementTree.Element("mujoco", model="drumming")
    _element(root, "compiler", angle="radian", meshdir=str(folder / "meshes"), autolimits="true")
    _element(root, "option", timestep=PHYSICS_DT, integrator="implicitfast", cone="elliptic")
    _element(root, "size", nuser_actuator=5)  # the arm's defaults have user data
    visual = _element(root, "visual")
    _element(visual, "global", offwidth=1280, offheight=960)
    _element(
        visual,
        "headlight",
        ambient="0.32 0.32 0.32",
        diffuse="0.35 0.35 0.35",
        specular="0.1 0.1 0.1",
    )
    _element(visual, "quality", shadowsize=2048, offsamples=4)
    for part in ElementTree.parse(folder / "assets.xml").getroot():
        if part.tag in ("asset", "default"):
            root.append(part)
    _add_look(root)
    world = _element(root, "worldbody")
    _add_surroundings(world)
    for drum in drums:
        _add_drum(world, drum)
    arm = ElementTree.parse(folder / "chain.xml").getroot()[0]
    _prepare_arm(arm)
    if not drawn:
        _strip_looks(root, arm)
    world.append(arm)
    actuators = _element(root, "actuator")
    for index, limit in enumerate(TORQUE_LIMITS.tolist(), start=1):
        joint = f"robot:panda0_joint{index}"
        _element(actuators, "motor", name=f"joint{index}", joint=joint, ctrlrange=[-limit, limit])
    return ElementTree.tostring(root, encoding="unicode")


def _prepare_arm(arm: ElementTree.Element) -> None:
    for body in arm.iter("body"):
        body.set("gravcomp", "1")
        for joint in list(body.findall("joint")):
            if "finger" in joint.get("name", ""):
                body.remove(joint)
                side = joint.get("axis", "").split()[1]  # opened as far as the stick is thick
                body.find("inertial")  # keeps its mass
                x, y, z = map(float, body.get("pos", "0 0 0").split())
                offset = float(side) * (STICK_RADIUS - 0.001)
                turn = np.pi / 4  # the fingers' frame is turned about z by -45 degrees
                x, y = x + offset * np.sin(turn), y + offset * np.cos(turn)
                body.set("pos", f"{x} {y} {z}")
            else:
                joint.set("class", "panda")
                joint.set("damping", "1")
                joint.set("armature", "0.1")
        for geom in body.findall("geom"):
            finger = "finger" in body.get("name", "")
            kind = geom.get("class", "")
            if finger and kind != "panda_viz":
                body.remove(geom)  # the closed fingers are drawn, and touch nothing
            elif kind == "panda_col":
                geom.set("contype", "0")
                geom.set("conaffinity", "2")
    hand = next(body for body in arm.iter("body") if body.get("name") == "panda0_link7")
    _add_stick(hand)


def _strip_looks(root: ElementTree.Element, arm: ElementTree.Element) -> None:
    """Remove the arm's geoms that are only drawn, and the meshes that no geom is left to use."""
    for body in arm.iter("body"):
        for geom in body.findall("geom"):
            if geom.get("class") == "panda_viz":
                body.remove(geom)
    used = {geom.get("mesh") for geom in arm.iter("geom")}
    for asset in root.findall("asset"):
        for mesh in asset.findall("mesh"):
            if mesh.get("name") not in used:
                asset.remove(mesh)


def _add_stick(hand: ElementTree.Element) -> None:
    """Add the stick: its frame is the world's when hand and stick have their pitches."""
    # In the world's axes the hand's x, y, z (z out of the flange, y along the fingers' travel).
    s, c = np.sin(HAND_PITCH), np.cos(HAND_PITCH)
    flange = np.array([[c, 0.0, s], [0.0, -1.0, 0.0], [s, 0.0, -c]])  # columns: hand axes
    turned = np.array([[1, 1, 0], [-1, 1, 0], [0, 0, np.sqrt(2)]]) / np.sqrt(2)  # hand in link 7
    world_in_link = turned @ flange.T
    body = _element(
        hand, "body", name="stick", pos=GRIP, quat=_quaternion(world_in_link), gravcomp=1
    )
    ahead = np.array([np.cos(STICK_PITCH), 0.0, -np.sin(STICK_PITCH)])
    tip, butt = STICK_FRONT * ahead, -STICK_BACK * ahead
    neck = (STICK_FRONT - 1.5 * TIP_RADIUS) * ahead
    touch = {"contype": 4, "conaffinity": 2, **HEAD_CONTACT}
    _element(
        body, "geom", name="stick:shaft", type="capsule", size=STICK_RADIUS, mass=0.045,
        fromto=[*butt, *neck], material="wood", **touch,
    )  # fmt: skip
    _element(
        body, "geom", name="stick:bead", type="sphere", size=TIP_RADIUS, mass=0.01, pos=tip,
        material="wood", **touch,
    )  # fmt: skip
    _element(body, "site", name="tip", pos=tip, size=0.002, rgba="0 0 0 0")


def _add_drum(world: ElementTree.Element, drum: Drum) -> None:
    """Add a drum: a head that is touched, in a rim, on a shell, on three legs.

    The head is a block, so that a contact points upward however deep the stick presses; the shell
    is drawn around it, and touched below it.
    """
    x, y, z = drum.head
    radius, depth, thickness = drum.radius, 0.16, 2 * HEAD_DEPTH
    inner = depth - HEAD_DEPTH
    body = _element(world, "body", name=f"drum:{drum.name}", pos=[x, y, z])
    _element(
        body, "geom", name=f"head:{drum.name}", type="cylinder", material="skin",
        size=[radius, thickness / 2], pos=[0, 0, -thickness / 2], contype=2, conaffinity=4,
        **HEAD_CONTACT,
    )  # fmt: skip
    _element(
        body, "geom", name=f"shell:{drum.name}", type="cylinder", material="shell",
        size=[radius + 0.004, depth / 2], pos=[0, 0, -0.008 - depth / 2], contype=0, conaffinity=0,
    )  # fmt: skip
    _element(
        body, "geom", name=f"stop:{drum.name}", type="cylinder", rgba="0 0 0 0",
        size=[radius, inner / 2], pos=[0, 0, -HEAD_DEPTH - inner / 2], contype=2, conaffinity=4,
    )  # fmt: skip
    for height in (-0.009, -depth - 0.004):
        _element(
            body, "geom", type="cylinder", material="metal", size=[radius + 0.007, 0.007],
            pos=[0, 0, height], contype=0, conaffinity=0,
        )  # fmt: skip
    for angle in 2 * np.pi * (np.arange(3) / 3) + np.pi / 6:
        lean = np.array([np.cos(angle), np.sin(angle)])
        top, foot = (radius + 0.006) * lean, (radius + 0.02) * lean
        _element(
            body, "geom", type="capsule", material="metal", size=0.006,
            fromto=[*top, -0.05, *foot, -z + 0.006], contype=0, conaffinity=0,
        )  # fmt: skip


def _add_surroundings(world: ElementTree.Element) -> None:
    _element(
        world, "geom", name="floor", type="plane", size=[0, 0, 0.1], material="floor",
        contype=2, conaffinity=4,
    )  # fmt: skip
    _element(
        world, "light", pos=[1.2, -0.8, 2.2], dir=[-0.5, 0.4, -1], diffuse=[0.5] * 3,
        specular=[0.2] * 3, directional="true",
    )  # fmt: skip
    _element(
        world, "light", pos=[0.2, 1.5, 2.0], dir=[0.2, -0.7, -1], diffuse=[0.15] * 3,
        specular=[0.0] * 3, directional="true", castshadow="false",
    )  # fmt: skip
    _element(world, "camera", name="front", fovy=33, **_view(CAMERA, CAMERA_TARGET))


def _view(eye: Sequence[float], target: Sequence[float]) -> dict[str, Any]:
    """Return where a camera is and how it is turned, upright, to look at a point."""
    back = np.subtract(eye, target)
    right = np.cross([0.0, 0.0, 1.0], back)
    up = np.cross(back, right)
    return {"pos": eye, "xyaxes": [*(right / np.linalg.norm(right)), *(up / np.linalg.norm(up))]}


def _add_look(root: ElementTree.Element) -> None:
    assets = _element(root, "asset")
    _element(
        assets, "texture", type="skybox", builtin="gradient", rgb1="0.93 0.95 0.97",
        rgb2="0.75 0.8 0.86", width=64, height=384,
    )  # fmt: skip
    _element(
        assets, "texture", name="floor", type="2d", builtin="checker", rgb1="0.88 0.89 0.90",
        rgb2="0.80 0.81 0.83", width=256, height=256,
    )  # fmt: skip
    _element(
        assets,
        "material",
        name="floor",
        texture="floor",
        texrepeat=[2, 2],
        texuniform="true",
        specular=0.1,
    )
    _element(assets, "material", name="wood", rgba="0.76 0.58 0.36 1")
    _element(assets, "material", name="skin", rgba="0.97 0.96 0.92 1")
    _element(assets, "material", name="metal", rgba="0.6 0.62 0.65 1", specular=0.8)
    _element(assets, "material", name="shell", rgba="0.70 0.16 0.14 1", specular=0.6)


def _element(parent: ElementTree.Element, tag: str, **attributes: Any) -> ElementTree.Element:
    """Add an element; numbers and sequences of them become MuJoCo's text."""
    return ElementTree.SubElement(parent, tag, {k: _text(v) for k, v in attributes.items()})


def _text(value: Any) -> str:
    if isinstance(value, str):
        return value
    return " ".join(format(float(number), ".12g") for number in np.atleast_1d(value))


def _quaternion(rotation: FloatArray) -> FloatArray:
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation).ravel())
    return quaternion
