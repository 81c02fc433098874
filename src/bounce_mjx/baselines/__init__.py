"""Controllers without a training, with which a policy is compared."""
