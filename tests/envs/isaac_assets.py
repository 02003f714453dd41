"""Replacements for the USD files that Isaac Lab's tasks download from a server.

Two carts on a rail, a dog with four legs and a ground plane, written with `pxr`. With them, the
real simulator builds and steps its own Cartpole, Pendulum and Unitree Go2 tasks without a network.
``python isaac_assets.py FOLDER`` writes them for tests that run under another Python. Left out on
purpose: everything visual.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TypeAlias

from pxr import Gf, Usd, UsdGeom, UsdPhysics

ROBOTS = Path("Isaac/IsaacLab/Robots")
GROUND = Path(
    "Isaac/IsaacLab/Environments/Grid/default_ground_plane_checker_v1/default_ground_plane.usda"
)
ROD_LENGTH = 1.0
LEGS = {"FL": (0.2, 0.1), "FR": (0.2, -0.1), "RL": (-0.2, 0.1), "RR": (-0.2, -0.1)}
LEG_PART = 0.2

Point: TypeAlias = tuple[float, float, float]


def write_assets(root: Path) -> Path:
    """Write every file under `root` and return `root`, the value for ISAACSIM_ASSET_ROOT."""
    _write_cart(root / ROBOTS / "Classic/Cartpole/cartpole.usd", rods=("pole",))
    _write_cart(
        root / ROBOTS / "Classic/CartDoublePendulum/cart_double_pendulum.usd",
        rods=("pole", "pendulum"),
    )
    _write_dog(root / ROBOTS / "Unitree/Go2/go2.usd")
    _write_ground(root / GROUND)
    return root


def _new_stage(path: Path) -> Usd.Stage:
    path.parent.mkdir(parents=True, exist_ok=True)
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    return stage


def _new_robot(path: Path) -> Usd.Stage:
    stage = _new_stage(path)
    robot = UsdGeom.Xform.Define(stage, "/robot")
    stage.SetDefaultPrim(robot.GetPrim())
    UsdPhysics.ArticulationRootAPI.Apply(robot.GetPrim())
    return stage


def _write_cart(path: Path, rods: tuple[str, ...]) -> None:
    stage = _new_robot(path)
    _add_body(stage, "slider", at=(0.0, 0.0, 0.0), size=(8.0, 0.03, 0.03), mass=1.0)
    _add_body(stage, "cart", at=(0.0, 0.0, 0.0), size=(0.2, 0.25, 0.2), mass=1.0)
    fixed = UsdPhysics.FixedJoint.Define(stage, "/robot/slider/root_joint")
    fixed.CreateBody1Rel().SetTargets(["/robot/slider"])
    slide = UsdPhysics.PrismaticJoint.Define(stage, "/robot/slider/slider_to_cart")
    _connect(slide, "slider", "cart", at=(0.0, 0.0, 0.0))
    slide.CreateAxisAttr("X")
    slide.CreateLowerLimitAttr(-4.0)
    slide.CreateUpperLimitAttr(4.0)
    UsdPhysics.DriveAPI.Apply(slide.GetPrim(), "linear").CreateTypeAttr("force")
    parent, top = "cart", 0.0
    for rod in rods:
        _add_body(
            stage, rod, at=(0.0, 0.0, top + ROD_LENGTH / 2), size=(0.04, 0.06, ROD_LENGTH), mass=0.5
        )
        _add_hinge(stage, f"{parent}_to_{rod}", parent, rod, axis="Y", at=(0.0, 0.0, top))
        parent, top = rod, top + ROD_LENGTH
    stage.Save()


def _write_dog(path: Path) -> None:
    stage = _new_robot(path)
    base = _add_body(stage, "base", at=(0.0, 0.0, 0.0), size=(0.4, 0.2, 0.1), mass=7.0)
    _add_collider(base, 0.05)
    for leg, (x, y) in LEGS.items():
        corner, knee, end = (x, y, 0.0), (x, y, -LEG_PART), (x, y, -2 * LEG_PART)
        part = (0.04, 0.04, LEG_PART)
        _add_body(stage, f"{leg}_hip", at=corner, size=(0.06, 0.06, 0.06), mass=0.7)
        _add_body(stage, f"{leg}_thigh", at=(x, y, -LEG_PART / 2), size=part, mass=1.0)
        _add_body(stage, f"{leg}_calf", at=(x, y, -1.5 * LEG_PART), size=part, mass=0.2)
        foot = _add_body(stage, f"{leg}_foot", at=end, size=(0.04, 0.04, 0.04), mass=0.05)
        _add_collider(foot, 0.02)
        _add_hinge(stage, f"{leg}_hip_joint", "base", f"{leg}_hip", axis="X", at=corner)
        _add_hinge(stage, f"{leg}_thigh_joint", f"{leg}_hip", f"{leg}_thigh", axis="Y", at=corner)
        _add_hinge(stage, f"{leg}_calf_joint", f"{leg}_thigh", f"{leg}_calf", axis="Y", at=knee)
        ankle = UsdPhysics.FixedJoint.Define(stage, f"/robot/{leg}_calf/{leg}_foot_joint")
        _connect(ankle, f"{leg}_calf", f"{leg}_foot", at=end)
    stage.Save()


def _add_body(stage: Usd.Stage, name: str, at: Point, size: Point, mass: float) -> UsdGeom.Xform:
    """Add a box without a shape."""
    body = UsdGeom.Xform.Define(stage, f"/robot/{name}")
    body.AddTranslateOp().Set(Gf.Vec3d(at))
    UsdPhysics.RigidBodyAPI.Apply(body.GetPrim())
    inertia = UsdPhysics.MassAPI.Apply(body.GetPrim())
    inertia.CreateMassAttr(mass)
    x, y, z = size
    inertia.CreateDiagonalInertiaAttr(
        Gf.Vec3f(y * y + z * z, x * x + z * z, x * x + y * y) * (mass / 12)
    )
    inertia.CreateCenterOfMassAttr(Gf.Vec3f(0.0))
    return body


def _add_collider(body: UsdGeom.Xform, radius: float) -> None:
    sphere = UsdGeom.Sphere.Define(body.GetPrim().GetStage(), f"{body.GetPath()}/collider")
    sphere.CreateRadiusAttr(radius)
    UsdPhysics.CollisionAPI.Apply(sphere.GetPrim())


def _add_hinge(stage: Usd.Stage, name: str, parent: str, child: str, axis: str, at: Point) -> None:
    hinge = UsdPhysics.RevoluteJoint.Define(stage, f"/robot/{parent}/{name}")
    _connect(hinge, parent, child, at)
    hinge.CreateAxisAttr(axis)
    UsdPhysics.DriveAPI.Apply(hinge.GetPrim(), "angular").CreateTypeAttr("force")


def _connect(joint: UsdPhysics.Joint, parent: str, child: str, at: Point) -> None:
    """Join two bodies at a point of the robot."""
    stage = joint.GetPrim().GetStage()
    offsets: list[Gf.Vec3f] = []
    for body in (parent, child):
        translation = stage.GetPrimAtPath(f"/robot/{body}").GetAttribute("xformOp:translate")
        offsets.append(Gf.Vec3f(Gf.Vec3d(at) - translation.Get()))
    joint.CreateBody0Rel().SetTargets([f"/robot/{parent}"])
    joint.CreateBody1Rel().SetTargets([f"/robot/{child}"])
    joint.CreateLocalPos0Attr(offsets[0])
    joint.CreateLocalPos1Attr(offsets[1])
    joint.CreateLocalRot0Attr(Gf.Quatf(1.0))
    joint.CreateLocalRot1Attr(Gf.Quatf(1.0))


def _write_ground(path: Path) -> None:
    stage = _new_stage(path)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    UsdGeom.Xform.Define(stage, "/World/GroundPlane")
    plane = UsdGeom.Plane.Define(stage, "/World/GroundPlane/CollisionPlane")
    plane.CreateAxisAttr("Z")
    UsdPhysics.CollisionAPI.Apply(plane.GetPrim())
    stage.Save()


if __name__ == "__main__":
    write_assets(Path(sys.argv[1]))
