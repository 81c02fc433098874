"""Physics engines behind one interface: `fused` (straight-line arithmetic) and `mjx`."""

from bounce_mjx.physics.engine import Engine, make_engine
from bounce_mjx.physics.state import PhysicsState

__all__ = ["Engine", "PhysicsState", "make_engine"]
