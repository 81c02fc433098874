"""An episode of an evaluation in the viewers, as it was (bit for bit on a CPU: `make_filmer`)."""

from collections.abc import Callable, Sequence

import jax
import numpy as np

from bounce_mjx.env.env import Env
from bounce_mjx.evaluation.failures import Film, film_episode
from bounce_mjx.evaluation.policy_evaluation import InEvaluation
from bounce_mjx.learning.policy import Actor, Policy
from bounce_mjx.task.task import Recording
from bounce_mjx.viewers.simulation import EnvFrame, Simulation, frame_at
from bounce_mjx.viewers.world import WorldSlider, sliders_for, with_sliders


class FilmPlayer(Simulation):
    """Plays the frames of one episode again and again; nothing that a user sets or pushes changes
    it. It has the interface of a simulation, and nothing of its state."""

    is_film = True

    def __init__(self, film: Film):
        """Compiles nothing."""
        self.env = film.env
        self.policy = None
        self.goal = {}
        # The controls then show the values that hold.
        self.world = None
        self.others = ()
        self._world = {name: np.asarray(value)[0] for name, value in film.statistics.world.items()}
        self.frames = episode_frames(film.env, film.recording)
        """Every frame of the episode [T, 1, ...]."""
        self._next = 0
        self.reset()

    @property
    def num_envs(self) -> int:
        """One."""
        return 1

    @property
    def frame(self) -> EnvFrame:
        """The current frame."""
        return self._frame

    @property
    def sliders(self) -> tuple[WorldSlider, ...]:
        """Sliders of the terms that the world of the episode can have."""
        return sliders_for(with_sliders(self.env.config))

    @property
    def world_values(self) -> dict[str, np.ndarray]:
        """Values of every active term of the world."""
        return self._world

    def world_value(self, term: str) -> float:
        """The first entry of a term of the world; of a term that is not active, the model's own."""
        if term in self._world:
            return float(np.ravel(self._world[term])[0])
        nominals = {slider.term: slider.nominal * slider.scale for slider in self.sliders}
        return nominals[term]

    def reset(self) -> None:
        """Begins the film again."""
        self._frame = frame_at(self.frames, 0)
        self._next = 1

    def push(self, velocity: tuple[float, float, float]) -> None:
        """Changes nothing."""

    def step(self) -> EnvFrame:
        """The next frame; after the last one, the first."""
        self._frame = frame_at(self.frames, self._next % len(self.frames.time))
        self._next = self._next % len(self.frames.time) + 1
        return self._frame

    def record(self, seconds: float | None = None) -> EnvFrame:
        """The frames of the whole episode, or the first one and those of the following seconds."""
        count = None if seconds is None else round(seconds / self.env.dt) + 1
        return jax.tree.map(lambda values: values[:count], self.frames)


def film_player(
    find: Callable[[], InEvaluation],
    actor: Callable[[Env], Actor],
    policy: Policy | None,
    seed: int,
) -> Callable[[], FilmPlayer]:
    """What simulates an episode of an evaluation, and gives its film.

    Args:
      find: gives its place in the evaluation.
      seed: of the evaluation's resets.
    """

    def simulate() -> FilmPlayer:
        setup, episodes, episode = find()
        acting = actor(setup.env)
        return FilmPlayer(film_episode(setup, acting, policy, episodes, seed, episode))

    return simulate


def episode_frames(
    env: Env, recording: Recording, episode: int = 0, seconds: float | None = None
) -> EnvFrame:
    """A recorded episode up to its end, or its first seconds, as frames [T, 1, ...].

    Args:
      episode: its place in the recording.
    """
    one = slice(episode, episode + 1)
    length = int(np.sum(recording.running[:, episode]))
    steps = length if seconds is None else min(length, round(seconds / env.dt))
    recorded = jax.tree.map(lambda x: np.asarray(x)[:steps, ..., one], recording)
    qpos = np.moveaxis(recorded.qpos, -1, 1)
    over = np.zeros((steps, 1), bool)
    over[-1] = steps == length
    return EnvFrame(
        time=env.dt * np.arange(1, steps + 1)[:, None],
        qpos=qpos,
        balls=np.stack([qpos[..., list(ball.qpos[:3])] for ball in env.addresses.balls], axis=2),
        paddle=np.moveaxis(recorded.paddle, -1, 1),
        goal=recorded.goal,
        metrics=recorded.metrics,
        over=over,
        lost=recorded.terminated,
    )


def world_rows(values: dict[str, np.ndarray]) -> Sequence[tuple[str, str]]:
    """Each term of a world, and its value in words."""
    rows = []
    for name, value in values.items():
        numbers = " ".join(f"{x:.3g}" for x in np.ravel(value))
        rows.append((name.replace("_", " "), numbers))
    return rows
