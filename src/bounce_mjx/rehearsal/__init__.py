"""A rehearsal: an arm on MuJoCo's C engine with the delays, the noise and the errors of a world,
behind the interface of a real arm's driver (`deploy.session.Arm`), and faults to put into it."""
