"""What viewers draw: the model with the task's markers, its geoms as meshes, the ball's path."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence

import mujoco
import numpy as np
import trimesh

from bounce_mjx.env.env import Env
from bounce_mjx.robot.arm import compile_spec
from bounce_mjx.robot.model import add_balls, scene_spec
from bounce_mjx.task.task import Marker
from bounce_mjx.viewers.simulation import EnvFrame
from bounce_mjx.world.config import WorldConfig

# By default MuJoCo shows the geom groups 0 to 2.
_SHOWN_GROUPS = 3
_SEGMENTS = 40
# Width of the outline of a frame, m.
_EDGE = 0.004
_CREASE_ANGLE = np.radians(30.0)

# With the task's focus at _USUAL_FOCUS, the camera looks at this point, from a place that far from
# it, and sees one arm and its ball up to the highest target.
_USUAL_FOCUS = np.array([0.58856, 0.0, 0.05])
_LOOK_AT = np.array([0.34, 0.0, 0.44])
_VIEW = np.array([1.06, -1.17, 0.42])
_HIGHEST = 0.85
FIELD_OF_VIEW = 40.0
"""Vertical angle of the camera's view, degrees."""
# A canvas that is narrower than this, such as a phone's, needs a more distant camera.
_FULL_ASPECT = 0.9
# On a page that is narrower than this, the panel covers the lower three fifths: the camera moves
# away by a factor, and down by a share of what it sees.
_PHONE_ASPECT = 0.6
_PHONE_DISTANCE = 1.25
_PHONE_SHIFT = 0.275

TRAIL_SECONDS = 0.6
"""Age of the end of the line, s."""
TRAIL_RGB = np.array([235.0, 85.0, 0.0])
"""Colour of its newest part, from 0 to 255."""

NO_METRICS: Mapping[str, float] = defaultdict(float)
"""Metrics before the first step."""


class Display:
    """A model for display, and the poses of its parts for given coordinates. The terms of a sampled
    world, such as the paddle's tilt, are not drawn."""

    def __init__(self, env: Env):
        self._task = env.task
        lowest = {name: goal.low for name, goal in env.config.goals.items()}
        self.model = _with_markers(env.config, env.task.markers(lowest, NO_METRICS))
        self.data = mujoco.MjData(self.model)

    def pose(
        self,
        qpos: np.ndarray,
        goal: dict[str, float],
        metrics: Mapping[str, float] = NO_METRICS,
    ) -> None:
        """Moves `data` to generalised positions [nq], and the markers to their places for the
        goals and the last step's metrics; their sizes and colours stay."""
        self.data.qpos[:] = qpos
        for marker in self._task.markers(goal, metrics):
            body = self.model.body(marker_body(marker.name))
            self.data.mocap_pos[body.mocapid] = marker.position
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)


def marker_body(name: str) -> str:
    """Name of a marker's body in the displayed model."""
    return f"marker {name}"


def _with_markers(config: WorldConfig, markers: Sequence[Marker]) -> mujoco.MjModel:
    """The config's model with a body for each marker, in place of its sites of their names."""
    spec, path = scene_spec(config.mjcf, config.robot)
    add_balls(spec, config.num_balls)
    names = {marker.name for marker in markers}
    for site in spec.sites:
        # All sites of the project's own file are markers, each of some task; only those of this
        # task are drawn, as bodies.
        if site.name in names or config.mjcf is None:
            site.group = _SHOWN_GROUPS
    for name, position, size, rgba, shape in markers:
        body = spec.worldbody.add_body(name=marker_body(name), pos=position, mocap=True)
        boxes = [((0.0, 0.0, 0.0), size)]
        if shape == "frame":
            # A plate would hide what a frame surrounds.
            boxes = _edges(size)
            rgba = (*rgba[:3], 0.9)
        is_round = shape == "cylinder"
        for center, half in boxes:
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CYLINDER if is_round else mujoco.mjtGeom.mjGEOM_BOX,
                pos=center,
                size=half,
                rgba=rgba,
                contype=0,
                conaffinity=0,
            )
    return compile_spec(spec, path)


def _edges(size: np.ndarray) -> list[tuple[list[float], list[float]]]:
    """Centres and half-sizes of the four edges around a plate of a half-size [3]."""
    x, y, z = size
    half = _EDGE / 2.0
    beside = [([side * (x + half), 0.0, 0.0], [half, y + _EDGE, z]) for side in (-1.0, 1.0)]
    return beside + [([0.0, side * (y + half), 0.0], [x, half, z]) for side in (-1.0, 1.0)]


def body_scenes(model: mujoco.MjModel) -> Iterator[tuple[int, trimesh.Scene]]:
    """Each body with visible geoms: its id, and those geoms as meshes in the body's frame."""
    for body in range(model.nbody):
        scene = trimesh.Scene()
        for geom in np.flatnonzero(model.geom_bodyid == body):
            mesh = _geom_mesh(model, geom)
            rgba = _color(model, geom)
            if mesh is None or rgba[3] == 0.0 or model.geom_group[geom] >= _SHOWN_GROUPS:
                continue
            mesh.visual = trimesh.visual.TextureVisuals(material=_material(rgba))
            pose = trimesh.transformations.quaternion_matrix(model.geom_quat[geom])
            pose[:3, 3] = model.geom_pos[geom]
            mesh.apply_transform(pose)
            scene.add_geometry(mesh)
        if scene.geometry:
            yield body, scene


def _geom_mesh(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh | None:
    """A geom's mesh in its own frame; None for a plane or a height field, which is not part of the
    robot."""
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.mesh(model.geom_dataid[geom])
        vertices = model.mesh_vert[mesh.vertadr.item() :][: mesh.vertnum.item()]
        faces = model.mesh_face[mesh.faceadr.item() :][: mesh.facenum.item()]
        return trimesh.graph.smooth_shade(trimesh.Trimesh(vertices, faces), angle=_CREASE_ANGLE)
    shape = _shape(mujoco.mjtGeom(int(model.geom_type[geom])), model.geom_size[geom])
    return shape and trimesh.graph.smooth_shade(shape, angle=_CREASE_ANGLE)


def _shape(kind: mujoco.mjtGeom, size: np.ndarray) -> trimesh.Trimesh | None:
    """The mesh of a shape of MuJoCo with these half-sizes [3], m; None for another kind."""
    count = [_SEGMENTS // 2, _SEGMENTS]
    match kind:
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            return trimesh.creation.uv_sphere(size[0], count=count)
        case mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            return trimesh.creation.uv_sphere(1.0, count=count).apply_scale(size)
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            return trimesh.creation.capsule(2.0 * size[1], size[0], count=count)
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            return trimesh.creation.cylinder(size[0], 2.0 * size[1], sections=_SEGMENTS)
        case mujoco.mjtGeom.mjGEOM_BOX:
            return trimesh.creation.box(2.0 * size)
    return None


def _color(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """The geom's colour [4] by MuJoCo's rule: the geom's own colour, or the material's if the geom
    has the default colour."""
    rgba = model.geom_rgba[geom]
    material = model.geom_matid[geom]
    is_default = np.allclose(rgba, (0.5, 0.5, 0.5, 1.0))
    if material >= 0 and is_default:
        return model.mat_rgba[material]
    return rgba


def _material(rgba: np.ndarray) -> trimesh.visual.material.PBRMaterial:
    # glTF uses linear colour factors, MuJoCo uses sRGB colours.
    linear = np.append(rgba[:3] ** 2.2, rgba[3])
    return trimesh.visual.material.PBRMaterial(
        baseColorFactor=np.round(linear * 255.0).astype(np.uint8),
        metallicFactor=0.1,
        roughnessFactor=0.55,
        alphaMode="OPAQUE" if rgba[3] >= 1.0 else "BLEND",
    )


class Trail:
    """The last positions of the balls of N environments, in frames that are `dt` seconds apart."""

    def __init__(self, dt: float):
        self.length = round(TRAIL_SECONDS / dt)
        """Number P of positions."""
        self.points: np.ndarray | None = None
        """Positions [P, N, B, 3], the oldest first, m; where an episode is shorter, its first
        position comes several times. None before the first frame."""

    def add(self, frame: EnvFrame) -> None:
        """Adds a frame's positions; those of an environment that is still in its last frame, as in
        a pause, are there already."""
        if self.points is None:
            self.points = np.tile(frame.balls, (self.length, 1, 1, 1))
            self._time = frame.time
        advanced = frame.time > self._time
        self.points[:-1, advanced] = self.points[1:, advanced]
        self.points[-1, advanced] = frame.balls[advanced]
        # A reset after a reset is at the same time, with its balls elsewhere.
        is_same = (frame.time == self._time) & np.all(frame.balls == self.points[-1], axis=(1, 2))
        restarted = ~advanced & ~is_same
        self.points[:, restarted] = frame.balls[restarted]
        self._time = frame.time


def camera_pose(
    offsets: np.ndarray, focus: np.ndarray, aspect: float = 1.0, zoom: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Position of a camera that sees all environments, and the point that it looks at, each [3], m.

    Args:
      offsets: positions of the environments [N, 3], m.
      focus: the task's point [3] in the middle of the picture (`Task.focus`), m.
      aspect: width / height of the picture.
      zoom: how much larger the focus is shown; the camera then turns towards it.
    """
    *aside, rise = focus - _USUAL_FOCUS
    rise = max(0.0, rise)
    size = 1.0 + max(rise / _HIGHEST, np.linalg.norm(aside))
    look_at = _LOOK_AT + 0.5 * np.array([*aside, rise])
    extent = size + 1.05 * np.linalg.norm(np.ptp(offsets, axis=0))
    view = extent * max(1.0, _FULL_ASPECT / aspect) * _VIEW
    # Seen from so much nearer, a height over the focus that shrinks by the zoom stays where it was
    # in the picture. What is beside the focus shrinks faster, and so comes to its middle.
    look_at = focus + (look_at - focus) / (zoom**2, zoom**2, zoom)
    if aspect < _PHONE_ASPECT:
        view = _PHONE_DISTANCE * view
        seen = 2.0 * np.linalg.norm(view) * np.tan(np.radians(0.5 * FIELD_OF_VIEW))
        up = np.cross(view, np.cross((0.0, 0.0, 1.0), view))
        look_at = look_at - _PHONE_SHIFT * seen * up / np.linalg.norm(up)
    return look_at + view / zoom, look_at
