"""Draws the pictures of the documentation: `python docs/pictures.py [NAME ...]`, all by default.

The diagrams need matplotlib only; the others run the policies that come with the package, and the
animations need OpenGL. `bounce-mjx plot` draws curves.svg, rewards.svg and evaluation.svg.
"""

import re
import subprocess
import sys
from pathlib import Path

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt
import numpy as np
from PIL import Image, ImageDraw, ImageFont

CHECKOUT = Path(__file__).resolve().parents[1]
IMAGES = CHECKOUT / "docs/images"
NOTES = CHECKOUT / "benchmarks/notes.md"
PAPER, BLUE, GREEN, ORANGE, GREY = "#f4f6f8", "#cfe3f7", "#d5efd8", "#fde3c8", "#52606d"
LINES = ["#1f77b4", "#e8590c", "#2f9e44", "#9c36b5", "#868e96", "#c92a2a"]

plt.rcParams |= {
    "font.size": 10,
    # Text stays text: small files, and words that a reader can search.
    "svg.fonttype": "none",
    "svg.hashsalt": "bounce_mjx",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "legend.frameon": False,
}


class Diagram:
    """Boxes and arrows on a page of 100 units in width."""

    def __init__(self, height: float):
        self.figure = plt.figure(figsize=(8.4, 8.4 * height / 100))
        self.axes = self.figure.add_axes((0, 0, 1, 1))
        self.axes.set(xlim=(0, 100), ylim=(height, 0))
        self.axes.axis("off")

    def box(self, x, y, width, height, title, text="", colour=PAPER, mono=False):
        """A box with its upper left corner at (x, y)."""
        shape = matplotlib.patches.FancyBboxPatch(
            (x + 0.6, y + 0.6), width - 1.2, height - 1.2, "round,pad=0.6,rounding_size=1.2",
            facecolor=colour, edgecolor=GREY, linewidth=0.8,
        )  # fmt: skip
        self.axes.add_patch(shape)
        lines = text.count("\n") + 1 if text else 0
        middle = y + height / 2
        self.text(
            x + width / 2, middle - 1.5 * lines, title, weight="bold",
            family="monospace" if mono else None,
        )  # fmt: skip
        if text:
            self.text(x + width / 2, middle + 1.6, text, size=9)

    def text(self, x, y, text, size=10, align="center", **style):
        self.axes.text(
            x, y, text, size=size, ha=align, va="center", linespacing=1.25, color="#1f2933", **style
        )

    def arrow(self, start, end, both=False, colour=GREY):
        style = {"arrowstyle": "<|-|>" if both else "-|>", "color": colour, "lw": 1.3}
        style |= {"mutation_scale": 11, "shrinkA": 0, "shrinkB": 0}
        self.axes.annotate("", end, start, arrowprops=style)


def task():
    """What a task gives to the world, and who asks it for what."""
    diagram = Diagram(46)
    diagram.box(
        1, 3, 30, 39, "the world", "arm, ball, physics,\nsensors, latency,\nrandomisation", GREEN
    )
    diagram.box(36, 3, 30, 39, "", "", BLUE)
    diagram.text(51, 8, "your task", weight="bold")
    rows = (
        ("Config, commands", "settings, flags,\nsliders, options"),
        ("reset, step", "training: reward,\nend, metrics"),
        ("tally, results", "eval, robustness,\nreport"),
        ("markers, readings, plots", "viewers, report"),
        ("next_quantities", "observation,\nONNX graph"),
    )
    for i, (method, user) in enumerate(rows):
        y = 14 + 6 * i
        diagram.text(51, y, method, size=9, family="monospace")
        diagram.text(84, y, user, size=9)
        diagram.arrow((66, y), (74, y))
    diagram.arrow((31, 20), (36, 20), both=True)
    return diagram.figure


def control_step():
    """The delays between the ball and the arm, and the settings that simulate them."""
    diagram = Diagram(56)
    rows = ("ball", "camera", "encoders", "policy", "servos")
    for i, name in enumerate(rows):
        diagram.text(1, 7 + 10 * i, name, align="left", weight="bold")
        diagram.axes.axhline(10.5 + 10 * i, 0.14, 0.99, color=GREY, lw=0.6)
    scale = 2.05  # units for each millisecond, from x = 15

    def at(milliseconds):
        return 15 + scale * milliseconds

    times = np.linspace(0.0, 40.0, 200)
    diagram.axes.plot(at(times), 8.8 - 0.0045 * (1600 - (times - 40) ** 2), color=LINES[1], lw=2)
    for picture in range(5):
        diagram.axes.plot(2 * [at(1 + 8.33 * picture)], [14.5, 20.5], color=LINES[0], lw=2.5)
    for step in range(5):
        diagram.axes.plot(2 * [at(10 * step)], [24.5, 30.5], color=LINES[2], lw=2.5)
    diagram.text(at(5.2), 12.6, "camera_rate", size=9, family="monospace", backgroundcolor="white")
    diagram.axes.annotate(
        "", (at(20), 36), (at(9.33), 20.5), arrowprops={"arrowstyle": "-|>", "color": LINES[0]}
    )
    diagram.text(at(18.6), 23, "ball_latency", size=9, family="monospace", backgroundcolor="white")
    diagram.axes.annotate(
        "", (at(20), 36), (at(20), 30.5), arrowprops={"arrowstyle": "-|>", "color": LINES[2]}
    )
    diagram.axes.barh(37.8, 2.5 * scale, 4, at(20), color=ORANGE, edgecolor=GREY)
    diagram.text(at(23.2), 37.8, "policy.step: less than 1 ms", size=9, align="left")
    diagram.axes.annotate(
        "", (at(34), 46), (at(22.5), 39.8), arrowprops={"arrowstyle": "-|>", "color": LINES[3]}
    )
    diagram.text(at(23), 44, "action_latency", size=9, family="monospace", backgroundcolor="white")
    lag = np.linspace(0, 6, 50)
    diagram.axes.plot(at(34 + lag), 50 - 3.5 * (1 - np.exp(-lag / 2)), color=LINES[3], lw=2)
    diagram.axes.plot(at(np.array([15, 34])), [50, 50], color=LINES[3], lw=2)
    diagram.text(at(33.4), 47.2, "servo_lag", size=9, family="monospace", align="right")
    for step in range(5):
        diagram.text(at(10 * step), 53.5, f"{10 * step} ms", size=9)
    return diagram.figure


def start_times():
    """Where the time of a first and of a second start goes on a CPU, from notes.md."""
    table = NOTES.read_text(encoding="utf-8").split("\n| seed | start | import |", 1)[1]
    figure, axes = plt.subplots(figsize=(8.4, 1.8), layout="constrained")
    names = ("import", "setup", "compile", "train and evaluate")
    for row, start in enumerate(("first", "second")):
        cells = re.search(rf"^\| 1 \| {start} \|(.+)\|$", table, re.MULTILINE)[1].split("|")[:4]
        *phases, end = map(float, cells)
        left = 0.0
        for i, value in enumerate((*phases, end - sum(phases))):
            axes.barh(start, value, left=left, color=LINES[i], label=None if row else names[i])
            left += value
        axes.text(left + 0.4, row, f"{end:.0f} s", va="center")
    axes.invert_yaxis()
    axes.set(xlabel="time until all five results are met, s (2 cores, seed 1)")
    axes.set(xlim=(0, 46), ylabel="start")
    axes.grid(axis="y", visible=False)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=1.0)
    return figure


def late_arms():
    """Share of lasting episodes and of right heights over the action latency, from notes.md."""
    table = NOTES.read_text(encoding="utf-8").split("\n| ms | measured angles |", 1)[1]
    rows = re.findall(
        r"^\| (\d+) \| (.+) / (.+) \| (.+) / (.+) \| (.+) / (.+) \|$", table, re.MULTILINE
    )
    latency, *shares = np.array(rows, float).T
    labels = "the measured angles", "the last targets", "the last targets, lead seen"
    figure, axes = plt.subplots(1, 2, figsize=(8.4, 2.8), sharey=True, layout="constrained")
    for column, title in enumerate(("episodes that last 20 s, %", "right heights, %")):
        for i, label in enumerate(labels):
            axes[column].plot(
                latency, shares[2 * i + column], "o-", ms=3, color=LINES[i], label=label
            )
        axes[column].set(title=title, xlabel="action latency, ms", ylim=(-3, 103))
    axes[0].legend(title="actions add to", loc="lower left")
    return figure


def rollout(observation=None, randomization=None, seconds=3.0, target=0.5):
    """An episode of `pretrained`, which acts on the true state: times, observations and their
    layout, true quantities, metrics."""
    import jax

    from bounce_mjx import BounceBall
    from bounce_mjx.learning.policy import make_networks
    from bounce_mjx.runs.checkpoints import read_policy
    from bounce_mjx.runs.config import load_run_config
    from bounce_mjx.runs.folders import find_checkpoint
    from bounce_mjx.task.bounce import Config as EnvConfig

    checkpoint = find_checkpoint("pretrained")
    config = load_run_config(checkpoint.run)
    layout = EnvConfig().layout
    networks = make_networks(config.ppo, layout.size, 6)
    policy = read_policy(checkpoint, config)
    changes = {"observation": observation or {}, "randomization": randomization or {}}
    env = BounceBall(EnvConfig(target_height_range=(target, target), **changes))

    def step(state, _):
        truth = env.kinematics(state.pipeline_state)
        height = state.pipeline_state.goal["target_height"]
        values = truth._asdict() | {"target_height": height[None]}
        state = env.step(state, networks.act(policy, layout.pack(values)))
        return state, (state.obs, env.kinematics(state.pipeline_state), state.metrics)

    run = jax.jit(lambda key: jax.lax.scan(step, env.reset(key), None, round(seconds / env.dt))[1])
    seen, truth, metrics = jax.tree.map(np.asarray, run(jax.random.key(0)))
    return env.dt * np.arange(1, len(seen) + 1), seen, env.layout, truth, metrics


def episode():
    """The ball's height at the start of an episode, with the quantities of the task."""
    time, _, _, truth, metrics = rollout()
    figure, axes = plt.subplots(figsize=(8.4, 3.6), layout="constrained")
    axes.axhspan(0.4, 0.6, color=GREEN, label="result 3: apex within 0.1 m of the target")
    axes.axhline(0.5, color=LINES[2], lw=1, label="target height")
    axes.plot(time, truth.ball_position[:, 2], color=LINES[1], lw=2, label="ball")
    axes.plot(time, truth.paddle_position[:, 2], color=LINES[0], lw=2, label="paddle")
    bounces = metrics["bounced"] > 0
    axes.plot(
        time[bounces], truth.ball_position[bounces, 2], "o", color="black", ms=5, label="bounce"
    )
    axes.axhline(0.05, color=LINES[5], lw=1, ls="--", label="the ball is lost")
    axes.set(xlabel="time, s", ylabel="height, m", ylim=(0, 0.68), xlim=(0, time[-1]))
    axes.legend(loc="upper center", ncols=3, bbox_to_anchor=(0.5, 1.3))
    return figure


def reward_terms():
    """Weighted terms over two bounces."""
    time, _, _, truth, metrics = rollout()
    part = (time > 1.0) & (time < 2.2)
    names = (
        "height",
        "position",
        "velocity_matching",
        "controlled_upward",
        "alignment",
        "paddle_home",
    )
    figure, axes = plt.subplots(figsize=(8.4, 3.6), layout="constrained")
    for name, colour in zip(names, LINES, strict=True):
        axes.plot(time[part], metrics[f"reward/{name}"][part], color=colour, lw=1.6, label=name)
    total = sum(value for name, value in metrics.items() if name.startswith("reward/"))
    axes.plot(time[part], total[part], color="black", lw=2, label="sum of all terms")
    for bounce in time[part & (metrics["bounced"] > 0)]:
        axes.axvline(bounce, color=GREY, lw=0.8, ls=":")
    axes.set(xlabel="time, s", ylabel="weighted reward", xlim=(1.0, 2.2))
    axes.legend(loc="upper center", ncols=4, bbox_to_anchor=(0.5, 1.25))
    return figure


def sensors():
    """A camera's pictures of a flight."""
    camera = {"camera_rate": (60.0, 60.0), "ball_latency": (0.02, 0.02)}
    camera |= {"ball_position_noise": (0.005, 0.005)}
    time, seen, layout, truth, _ = rollout({}, camera)
    rough = rollout({"velocity": "differences"}, camera)
    part = (time > 1.0) & (time < 2.2)
    figure, (top, bottom) = plt.subplots(
        2, 1, figsize=(8.4, 4.8), layout="constrained", sharex=True
    )
    for axes, name, true in (
        (top, "ball_position", truth.ball_position[:, 2]),
        (bottom, "ball_velocity", truth.ball_velocity[:, 2]),
    ):
        measured = seen if name == "ball_position" else rough[1]
        label = "last picture" if name == "ball_position" else "difference of two pictures"
        where = layout[name].start + 2
        axes.plot(time[part], true[part], color="black", lw=2, label="true")
        axes.plot(time[part], measured[part, where], ".", color=LINES[1], ms=4, label=label)
        axes.legend(loc="upper right", bbox_to_anchor=(1.0, 1.17), ncols=2)
    top.set(ylabel="height of the ball, m")
    bottom.set(ylabel="vertical velocity, m/s", xlabel="time, s", xlim=(1.0, 2.2))
    return figure


def two_policies():
    """Both shipped policies on the C engine, with and without a camera."""
    from bounce_mjx import load_policy
    from bounce_mjx.deploy.environments import environment_config
    from bounce_mjx.deploy.session import play
    from bounce_mjx.rehearsal.arm import SimulatedArm, goals_in_turn
    from bounce_mjx.rehearsal.operator import SimulatedOperator

    late = {"camera_rate": 120.0, "ball_position_noise": 0.002, "ball_latency": 0.02}
    figure, row = plt.subplots(1, 2, figsize=(8.4, 3.0), layout="constrained", sharey=True)
    for axes, title, world in (
        (row[0], "perfect sensors", {}),
        (row[1], "camera: 120 Hz, 2 mm, 20 ms late", late),
    ):
        axes.axhline(0.5, color=LINES[2], lw=1, ls="--")
        for name, colour in (("pretrained", LINES[1]), ("robust", LINES[0])):
            config = environment_config(policy=name)
            arm = SimulatedArm(config, world)
            goals = goals_in_turn(config, {"target_height": (0.5,)})
            play(load_policy(name), arm, 5.0, SimulatedOperator(arm), goals, {})
            height = arm.balls[0].qpos[2]
            time, shown = np.array([(moved.time, moved.qpos[height]) for moved in arm.path]).T
            axes.plot(time, shown, color=colour, lw=1.6, label=name)
        axes.set(title=title, xlabel="time, s", xlim=(0, 5), ylim=(0, 0.72))
        axes.legend(loc="upper right", ncols=2)
    row[0].set(ylabel="height of the ball, m")
    return figure


def gradient():
    """The derivative of the ball's height by every earlier action, through a bounce."""
    import jax
    import jax.numpy as jnp

    from bounce_mjx import BounceBall

    env = BounceBall()
    start = jax.jit(env.reset)(jax.random.key(0))

    def height(actions):
        def step(state, action):
            state = env.step(state, action)
            return state, env.kinematics(state.pipeline_state).ball_position[2]

        heights = jax.lax.scan(step, start, actions)[1]
        return heights[-1], heights

    program = jax.jit(jax.value_and_grad(height, has_aux=True))
    (_, heights), slopes = jax.tree.map(np.asarray, program(jnp.zeros((40, env.action_size))))
    time = env.dt * np.arange(1, 41)
    figure, (top, bottom) = plt.subplots(
        2, 1, figsize=(8.4, 4.2), layout="constrained", sharex=True
    )
    top.plot(time, heights, color=LINES[1], lw=2)
    top.set(ylabel="ball height, m")
    for i, colour in enumerate(LINES):
        bottom.plot(time, slopes[:, i], color=colour, lw=1.6, label=f"Joint{i + 1}")
    bottom.set(xlabel="time of the action, s", ylabel="d last height / d action, m", xlim=(0, 0.4))
    bottom.legend(ncols=6, loc="upper center", bbox_to_anchor=(0.5, 1.22))
    return figure


def parity():
    """A run as `test_2000_random_action_steps_are_mujocos`, with every step's differences."""
    import jax

    jax.config.update("jax_enable_x64", True)
    sys.path.insert(0, str(CHECKOUT / "tests"))
    import against_c as tests
    from bounce_mjx import BounceBall
    from bounce_mjx.physics import PhysicsState, make_engine
    from test_physics import batched

    model, rng = BounceBall().mj_model, np.random.default_rng(4)
    step = batched(make_engine(model, "fused").step)
    state = tests.bouncing_states(model, rng)
    reference = tests.CEngine(model, state)
    errors, contacts = [], []
    for i in range(2000):
        if i % 10 == 0:
            action = rng.uniform(-0.03, 0.03, (tests.BATCH, 6))
            state = PhysicsState(*(np.array(x) for x in state[:2]))
            for data, qpos, qvel in zip(reference.data, *state[:2], strict=True):
                if data.qpos[8] < tests.paddle_frame(model, data.qpos[:6])[0][2] - 0.1:
                    tests.drop_ball(model, data.qpos, data.qvel, rng)
                    qpos[6:9], qvel[6:] = data.qpos[6:9], data.qvel[6:]
            ctrl, c_ctrl = state.qpos[:, :6] + action, reference.state.qpos[:, :6] + action
        state, single = step(state, ctrl, 1), step(reference.state, c_ctrl, 1)
        contacts.append(reference.step(c_ctrl, 1))
        after = reference.state
        errors.append([np.max(tests.differences(x, after)) for x in (state, single)])
    figure, axes = plt.subplots(figsize=(8.4, 3.2), layout="constrained")
    for error, label, colour in zip(
        np.transpose(errors), ("running freely", "one step from C's state"), LINES, strict=False
    ):
        axes.semilogy(np.arange(1, 2001), np.maximum(error, 1e-17), color=colour, lw=1, label=label)
    axes.axhline(1e-9, color="black", lw=0.8, ls="--")
    axes.axhline(1e-11, color="black", lw=0.8, ls="--")
    axes.set(
        xlabel=f"physics step ({tests.BATCH} environments, {sum(contacts):,} steps with contact)",
        ylabel="largest difference from C",
        ylim=(1e-16, 1e-8),
        xlim=(0, 2000),
    )
    axes.legend(ncols=3, loc="upper center", bbox_to_anchor=(0.5, 1.2))
    return figure


def arms():
    """The four arms of `configs/robots/` in their start poses; needs the packages of their MJCF."""
    import yaml

    from bounce_mjx import BounceBall, EnvConfig
    from bounce_mjx.viewers.offscreen import Renderer

    names = {"peitian": "AIR4-560", "ur5e": "UR5e", "panda": "Panda", "iiwa": "iiwa"}
    figure, row = plt.subplots(1, 4, figsize=(9.6, 2.9), layout="constrained")
    for axes, (name, title) in zip(row, names.items(), strict=True):
        file = CHECKOUT / "configs/robots" / f"{name}.yaml"
        config = EnvConfig.model_validate(yaml.safe_load(file.read_text())["env"])
        env = BounceBall(config)
        qpos, addresses = env.mj_model.qpos0.copy(), env.addresses
        qpos[addresses.arm_qpos,] = config.default_joint_angles
        qpos[addresses.balls[0].qpos[:3],] = config.ball_init_pos
        with Renderer(env, 480, 520) as renderer:
            axes.imshow(renderer.render(qpos, {"target_height": 0.5}))
        axes.set_title(title)
        axes.axis("off")
    return figure


def page():
    """A screenshot of the page of `bounce-mjx play`; needs Chromium and playwright."""
    import shutil

    from playwright.sync_api import sync_playwright

    command = [sys.executable, "-u", "-m", "bounce_mjx", "play", "pretrained"]
    server = subprocess.Popen(
        [*command, "--viewer", "browser", "--port", "8231"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        address = next(
            found[0] for line in server.stdout if (found := re.search(r"http:\S+", line))
        )
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(
                executable_path=shutil.which("chromium"),
                args="--no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader".split(),
            )
            shown = browser.new_page(viewport={"width": 1280, "height": 720})
            shown.goto(address)
            shown.wait_for_timeout(25_000)
            for close in shown.locator("[class*=Notification-closeButton]").all():
                close.click()
            shown.wait_for_timeout(1_000)
            shown.screenshot(path=IMAGES / "page.png")
            browser.close()
    finally:
        server.kill()


def simulators():
    """The policy `robust` with late actions and pictures of the ball in three simulators, side by
    side, drawn by MuJoCo; needs the extra `simulators` and OpenGL."""
    import jax

    sys.path.insert(0, str(CHECKOUT / "benchmarks"))
    import simulators as benchmark

    from bounce_mjx.env.env import Env
    from bounce_mjx.evaluation.episodes import reset_episodes
    from bounce_mjx.resources import POLICIES, resource_path
    from bounce_mjx.runs.config import load_run_config
    from bounce_mjx.viewers.offscreen import Renderer

    seed, every, steps = 3, 5, 400
    config = load_run_config(resource_path(POLICIES["robust"])).env
    env = Env(config.model_copy(update={"randomization": type(config.randomization)()}))
    start = jax.jit(reset_episodes, static_argnums=(0, 2))(env, jax.random.key(seed), 1)
    goal = {name: float(x[..., 0]) for name, x in start.pipeline_state.goal.items()}
    names = {"bullet": "PyBullet", "physx": "SAPIEN", "mujoco": "MuJoCo"}
    panels = []
    for name, title in names.items():
        world = benchmark.WORLDS["60 + 30 ms"]
        _, path = benchmark.evaluate("robust", name, world, 1, seed)
        with Renderer(env, 280, 280, zoom=1.3) as renderer:
            pictures = [Image.fromarray(renderer.render(qpos, goal)) for qpos in path[:steps:every]]
        for picture in pictures:
            ImageDraw.Draw(picture).text((10, 250), title, "white", ImageFont.load_default(20))
        panels.append(pictures)
    first, *others = (Image.fromarray(np.hstack(row)) for row in zip(*panels, strict=True))
    duration = round(1000 * every * env.dt)
    first.save(
        IMAGES / "simulators.webp", save_all=True, append_images=others, duration=duration,
        loop=0, quality=30, method=4,
    )  # fmt: skip


PICTURES = (
    task, control_step, start_times, late_arms, episode, reward_terms, sensors, two_policies,
    gradient, arms, page, simulators, parity,
)  # fmt: skip
"""`parity` is the last one, as it switches JAX to float64."""

_LATE = "--randomization.action-latency 0.06 0.06 --randomization.ball-latency 0.03 0.03"
FILMS = {
    "bounce": "pretrained --size 832 468 --zoom 1.4 --randomization.goal-interval 2 2",
    "track": "track --zoom 1.4",
    "balance": "balance --zoom 3",
    "catch": "catch --zoom 2 --seconds 4",
    "juggle": "juggle --zoom 1.7",
    "latency_pretrained": f"pretrained {_LATE} --zoom 1.2",
    "latency_robust": f"robust {_LATE} --zoom 1.2",
}
"""Arguments of `bounce-mjx play` by the name of its WebP."""


def film(name: str) -> None:
    """Records an animation; the later of two equal flags counts."""
    flags = f"--seconds 6 --size 400 300 {FILMS[name].partition(' ')[2]}".split()
    command = [sys.executable, "-m", "bounce_mjx", "play", FILMS[name].split()[0], *flags]
    subprocess.run([*command, "--fps", "20", "--video", IMAGES / f"{name}.webp"], check=True)


def save(draw) -> None:
    """Writes one picture: a diagram or a plot as SVG, a rendering as PNG with 200 colours."""
    figure = draw()
    raster = IMAGES / f"{draw.__name__}.png"
    if draw is arms:
        figure.savefig(raster, dpi=120)
    elif figure is not None:
        figure.savefig(raster.with_suffix(".svg"), facecolor="white", metadata={"Date": None})
    if draw in (arms, page):
        Image.open(raster).convert("RGB").quantize(200).save(raster, optimize=True)
    plt.close("all")


if __name__ == "__main__":
    wanted = sys.argv[1:] or [*FILMS, *(draw.__name__ for draw in PICTURES)]
    for name in FILMS:
        if name in wanted:
            film(name)
    for draw in PICTURES:
        if draw.__name__ in wanted:
            save(draw)
