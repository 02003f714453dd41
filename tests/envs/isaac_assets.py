"""Stand-ins for the USD files that Isaac Lab's tasks fetch from a server.

Two carts on a rail and a ground plane, written with `pxr`, enough for the real
simulator to build and step its own Cartpole and Pendulum tasks without a network.
``python isaac_assets.py FOLDER`` writes them for tests that run under another Python.
Absent on purpose: everything visual.
"""

from __future__ import annotations

import sys
from pathlib import Path

from pxr import Gf, Usd, UsdGeom, UsdPhysics

ROBOTS = Path("Isaac/IsaacLab/Robots/Classic")
GROUND = Path(
    "Isaac/IsaacLab/Environments/Grid/default_ground_plane_checker_v1/default_ground_plane.usda"
)
ROD_LENGTH = 1.0


def write_assets(root: Path) -> Path:
    """Write every file under `root` and return `root`, the value for ISAACSIM_ASSET_ROOT."""
    _write_cart(root / ROBOTS / "Cartpole/cartpole.usd", rods=("pole",))
    _write_cart(
        root / ROBOTS / "CartDoublePendulum/cart_double_pendulum.usd", rods=("pole", "pendulum")
    )
    _write_ground(root / GROUND)
    return root


def _new_stage(path: Path) -> Usd.Stage:
    path.parent.mkdir(parents=True, exist_ok=True)
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    return stage


def _write_cart(path: Path, rods: tuple[str, ...]) -> None:
    stage = _new_stage(path)
    robot = UsdGeom.Xform.Define(stage, "/robot")
    stage.SetDefaultPrim(robot.GetPrim())
    UsdPhysics.ArticulationRootAPI.Apply(robot.GetPrim())
    _add_body(stage, "slider", height=0.0, size=(8.0, 0.03, 0.03), mass=1.0)
    _add_body(stage, "cart", height=0.0, size=(0.2, 0.25, 0.2), mass=1.0)
    fixed = UsdPhysics.FixedJoint.Define(stage, "/robot/slider/root_joint")
    fixed.CreateBody1Rel().SetTargets(["/robot/slider"])
    slide = UsdPhysics.PrismaticJoint.Define(stage, "/robot/slider/slider_to_cart")
    _connect(slide, "slider", "cart", axis="X", parent_offset=0.0, child_offset=0.0)
    slide.CreateLowerLimitAttr(-4.0)
    slide.CreateUpperLimitAttr(4.0)
    UsdPhysics.DriveAPI.Apply(slide.GetPrim(), "linear").CreateTypeAttr("force")
    parent, top, offset = "cart", 0.0, 0.0
    for rod in rods:
        _add_body(stage, rod, height=top + ROD_LENGTH / 2, size=(0.04, 0.06, ROD_LENGTH), mass=0.5)
        hinge = UsdPhysics.RevoluteJoint.Define(stage, f"/robot/{parent}/{parent}_to_{rod}")
        _connect(hinge, parent, rod, axis="Y", parent_offset=offset, child_offset=-ROD_LENGTH / 2)
        UsdPhysics.DriveAPI.Apply(hinge.GetPrim(), "angular").CreateTypeAttr("force")
        parent, top, offset = rod, top + ROD_LENGTH, ROD_LENGTH / 2
    stage.Save()


def _add_body(
    stage: Usd.Stage, name: str, height: float, size: tuple[float, float, float], mass: float
) -> None:
    body = UsdGeom.Xform.Define(stage, f"/robot/{name}")
    body.AddTranslateOp().Set(Gf.Vec3d(0.0, 0.0, height))
    UsdPhysics.RigidBodyAPI.Apply(body.GetPrim())
    inertia = UsdPhysics.MassAPI.Apply(body.GetPrim())
    inertia.CreateMassAttr(mass)
    x, y, z = size
    inertia.CreateDiagonalInertiaAttr(
        Gf.Vec3f(y * y + z * z, x * x + z * z, x * x + y * y) * (mass / 12)
    )
    inertia.CreateCenterOfMassAttr(Gf.Vec3f(0.0))


def _connect(
    joint: UsdPhysics.PrismaticJoint | UsdPhysics.RevoluteJoint,
    parent: str,
    child: str,
    axis: str,
    parent_offset: float,
    child_offset: float,
) -> None:
    """Join two bodies at heights given in their own frames."""
    joint.CreateBody0Rel().SetTargets([f"/robot/{parent}"])
    joint.CreateBody1Rel().SetTargets([f"/robot/{child}"])
    joint.CreateAxisAttr(axis)
    joint.CreateLocalPos0Attr(Gf.Vec3f(0.0, 0.0, parent_offset))
    joint.CreateLocalPos1Attr(Gf.Vec3f(0.0, 0.0, child_offset))
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
