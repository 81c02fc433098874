"""Settings, whatever they are of.

| what | file |
|---|---|
| their types, and the base class of a group of them | `settings.py` |
| their command lines, and which flag a setting has (`flag_names`) | `command_line.py` |
| their YAML | `files.py` |
| values that are validated, or one sentence | `validation.py` |
| the user's own classes of tasks and algorithms, by name | `user_code.py` |
| lines of the user's code, for errors | `places.py` |
"""
