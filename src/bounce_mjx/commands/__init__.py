"""The commands of `bounce-mjx`, a file for each name in `main.COMMANDS`; and what several share:
the policy (`which_policy.py`) and the goals (`goals.py`). The flag --import, which each has, is
taken out of its words before it reads them (`main.main`)."""
