"""XLA's option that joins loops on a CPU, in processes of their own."""

import os
import re
import subprocess
import sys

# Two results of one value: with the option, one loop computes both.
PROGRAM = """
import os
import sys

from bounce_mjx.training.loop_fusion import join_loops

join_loops(*sys.argv[1:])
import jax
import jax.numpy as jnp

print("start with", repr(os.environ.get("XLA_FLAGS")), flush=True)


def abort(*_, **__):
    if os.environ.get("XLA_FLAGS"):
        os.abort()


{extra}
two = jax.jit(lambda x: (jnp.sin(x) * 2.0, jnp.sin(x) + x))
print(two.lower(jnp.ones(1000)).compile().as_text())
"""
# JAX calls these listeners inside its compiler, where XLA may abort too.
ABORT_IN_COMPILER = "jax.monitoring.register_event_listener(abort)"


def run(extra: str = "", *args: str, flags: str | None = None) -> subprocess.CompletedProcess:
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    if flags is not None:
        environment["XLA_FLAGS"] = flags
    return subprocess.run(
        [sys.executable, "-c", PROGRAM.format(extra=extra), *args],
        env=environment | {"JAX_PLATFORMS": "cpu"}, capture_output=True, text=True,
    )  # fmt: skip


def is_joined(done: subprocess.CompletedProcess) -> bool:
    """Whether one loop of the compiled program has several results."""
    assert done.returncode == 0, done.stderr
    return re.search(r"= \(.*\) fusion\(", done.stdout) is not None


def test_two_results_of_one_value_share_a_loop() -> None:
    assert is_joined(run())


def test_mjx_and_the_users_flags_have_priority() -> None:
    assert not is_joined(run("", "mjx"))
    assert not is_joined(run(flags=""))


def test_a_command_starts_again_where_xla_aborts() -> None:
    done = run(ABORT_IN_COMPILER)
    assert not is_joined(done)
    assert re.findall("start with '(.*)'", done.stdout) == [
        "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion",
        "",
    ]
    assert "starts again" in done.stderr


def test_other_aborts_end_the_process() -> None:
    done = run("abort()")
    assert done.returncode < 0
    assert "starts again" not in done.stderr
