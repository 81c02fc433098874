"""The displayed model: the two markers, and each visible geom as a mesh."""

from collections.abc import Iterator

import mujoco
import numpy as np
import trimesh

from bounce_mjx.robot.arm import compile_spec
from bounce_mjx.robot.model import scene_spec
from bounce_mjx.task.config import EnvConfig
from bounce_mjx.task.env import BounceBall

TARGET_SITE = "target_height"
HOME_SITE = "paddle_home"
HOME_EDGES = tuple(f"{HOME_SITE}_edge{i}" for i in range(4))
"""Markers of the home's outline; a plate would hide the paddle."""
MARKERS = (TARGET_SITE, *HOME_EDGES)
# By default MuJoCo shows the geom groups 0 to 2.
_SHOWN_GROUPS = 3
_SEGMENTS = 40
# Width of the outline of the paddle's home, m.
_EDGE = 0.004
_CREASE_ANGLE = np.radians(30.0)


class Display:
    """A model for display, and the poses of its parts for given coordinates."""

    def __init__(self, env: BounceBall):
        self.model = _with_markers(env.config)
        self.data = mujoco.MjData(self.model)
        self._config = env.config
        self._target = self.model.site(TARGET_SITE).id
        # MuJoCo ignores changes to a position that was zero in the file.
        self.model.site_sameframe[self._target] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE

    def pose(self, qpos: np.ndarray, target_height: float) -> None:
        """Moves `data` to generalised positions [nq] and the marker to a target height, m."""
        self.data.qpos[:] = qpos
        self.model.site_pos[self._target] = (
            self._config.reward.target_x,
            self._config.reward.target_y,
            target_height,
        )
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)


def _with_markers(config: EnvConfig) -> mujoco.MjModel:
    """The config's model, with the two marker sites added if it lacks them."""
    spec, path = scene_spec(config.mjcf, config.robot)
    sites = {site.name for site in spec.sites}
    reward = config.reward
    if TARGET_SITE not in sites:
        spec.worldbody.add_site(
            name=TARGET_SITE,
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[0.05, 0.001, 0],
            rgba=[0.15, 0.9, 0.3, 0.4],
        )
    if HOME_SITE not in sites:
        spec.worldbody.add_site(
            name=HOME_SITE,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[0.05, 0.065, 0.001],
            pos=[reward.target_x, reward.target_y, reward.paddle_home_height],
            rgba=[0.15, 0.45, 1.0, 0.45],
        )
    _add_outline(spec)
    return compile_spec(spec, path)


def _add_outline(spec: mujoco.MjSpec) -> None:
    """Replaces the plate of the paddle's home by the four edges around it."""
    home = spec.site(HOME_SITE)
    (x, y, z), material = home.size, spec.material(home.material)
    rgba = home.rgba.copy() if material is None else material.rgba.copy()
    home.rgba = [*rgba[:3], 0.0]
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, home.quat)
    half = _EDGE / 2.0
    edges = (
        ([x + half, 0.0], [half, y + _EDGE]),
        ([-x - half, 0.0], [half, y + _EDGE]),
        ([0.0, y + half], [x, half]),
        ([0.0, -y - half], [x, half]),
    )
    for name, (middle, size) in zip(HOME_EDGES, edges, strict=True):
        spec.worldbody.add_site(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=home.pos + rotation.reshape(3, 3) @ [*middle, 0.0],
            quat=home.quat,
            size=[*size, z],
            rgba=[*rgba[:3], 0.9],
            group=home.group,
        )


def body_scenes(model: mujoco.MjModel) -> Iterator[tuple[int, trimesh.Scene]]:
    """Each body with visible geoms: its id, and those geoms as meshes in the body's frame."""
    for body in range(model.nbody):
        scene = trimesh.Scene()
        for geom in np.flatnonzero(model.geom_bodyid == body):
            mesh = _geom_mesh(model, geom)
            rgba = _color(model, geom)
            if mesh is None or rgba[3] == 0.0 or model.geom_group[geom] >= _SHOWN_GROUPS:
                continue
            mesh.apply_transform(_transform(model.geom_pos[geom], model.geom_quat[geom]))
            mesh.visual = trimesh.visual.TextureVisuals(material=_material(rgba))
            scene.add_geometry(mesh)
        if scene.geometry:
            yield body, scene


def site_mesh(model: mujoco.MjModel, name: str) -> tuple[trimesh.Trimesh, np.ndarray]:
    """A marker's mesh in its own frame, and its colour [4] from 0 to 1."""
    site = model.site(name)
    material = site.matid.item()
    rgba = site.rgba if material < 0 else model.mat_rgba[material]
    return _primitive(site.type.item(), site.size), rgba


def _geom_mesh(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh | None:
    """A geom's mesh in its own frame; None for a plane or a height field, which is not part of the
    robot."""
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.mesh(model.geom_dataid[geom])
        vertices = model.mesh_vert[mesh.vertadr.item() :][: mesh.vertnum.item()]
        faces = model.mesh_face[mesh.faceadr.item() :][: mesh.facenum.item()]
        return trimesh.graph.smooth_shade(trimesh.Trimesh(vertices, faces), angle=_CREASE_ANGLE)
    return _primitive(model.geom_type[geom], model.geom_size[geom])


def _primitive(kind: int, size: np.ndarray) -> trimesh.Trimesh | None:
    """A sphere, capsule, ellipsoid, cylinder or box of MuJoCo's half-sizes [3], m."""
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_SPHERE:
        mesh = trimesh.creation.uv_sphere(size[0], count=[_SEGMENTS // 2, _SEGMENTS])
    elif kind == types.mjGEOM_ELLIPSOID:
        mesh = trimesh.creation.uv_sphere(1.0, count=[_SEGMENTS // 2, _SEGMENTS])
        mesh.apply_scale(size)
    elif kind == types.mjGEOM_CAPSULE:
        mesh = trimesh.creation.capsule(2.0 * size[1], size[0], count=[_SEGMENTS // 2, _SEGMENTS])
    elif kind == types.mjGEOM_CYLINDER:
        mesh = trimesh.creation.cylinder(size[0], 2.0 * size[1], sections=_SEGMENTS)
    elif kind == types.mjGEOM_BOX:
        mesh = trimesh.creation.box(2.0 * size)
    else:
        return None
    return trimesh.graph.smooth_shade(mesh, angle=_CREASE_ANGLE)


def _color(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """The geom's colour [4] by MuJoCo's rule: the geom's own colour, or the material's if the geom
    has the default colour."""
    own, material = model.geom_rgba[geom], model.geom_matid[geom]
    is_default = np.allclose(own, (0.5, 0.5, 0.5, 1.0))
    return model.mat_rgba[material] if material >= 0 and is_default else own


def _material(rgba: np.ndarray) -> trimesh.visual.material.PBRMaterial:
    # glTF uses linear colour factors, MuJoCo uses sRGB colours.
    linear = np.append(rgba[:3] ** 2.2, rgba[3])
    return trimesh.visual.material.PBRMaterial(
        baseColorFactor=np.round(linear * 255.0).astype(np.uint8),
        metallicFactor=0.1,
        roughnessFactor=0.55,
        alphaMode="OPAQUE" if rgba[3] >= 1.0 else "BLEND",
    )


def _transform(position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    transform = np.eye(4)
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, quaternion)
    transform[:3, :3], transform[:3, 3] = rotation.reshape(3, 3), position
    return transform
