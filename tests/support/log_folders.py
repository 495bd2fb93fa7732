"""A folder with two logs and one that is no log."""

from support.commands import PROBLEM, ROOM, log_of


def fill_folder(folder):
    """Write a problem, its model and a folder with two logs into a folder, and return it."""
    (folder / "logs").mkdir()
    for name, switch in (("monday", 3.2), ("tuesday", 2.1)):
        (folder / "logs" / f"{name}.csv").write_text(log_of(switch))
    (folder / "room.py").write_text(ROOM)
    (folder / "problem.toml").write_text(PROBLEM)
    return folder
