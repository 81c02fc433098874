"""Physics engines behind one interface, `fused` (straight-line arithmetic) and `mjx`; and MuJoCo's
C engine with the same friction (`CEngine`)."""

from bounce_mjx.physics.c_engine import CEngine
from bounce_mjx.physics.control import Control, servo_targets
from bounce_mjx.physics.edited import edited_model
from bounce_mjx.physics.engine import Engine, make_engine
from bounce_mjx.physics.parameters import PhysicsParameters, PhysicsState
