"""The wheel holds all that the rooms hold."""

import tomllib
from fnmatch import fnmatch
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_every_file_of_a_room_is_packaged():
    """setuptools leaves out folders that are not named, or warns that it will."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]
    assert set(project["packages"]) == set(project["package-dir"])
    packages = {
        folder: project["package-data"].get(name, []) for name, folder in project["package-dir"].items()
    }
    rooms = {folder for folder in packages if "/" not in folder}
    files = [path.relative_to(ROOT) for room in rooms for path in (ROOT / room).rglob("*") if path.is_file()]
    kept = [file for file in files if "__pycache__" not in file.parts]
    assert any(file.name == "report.html.j2" for file in kept)
    for file in kept:
        assert file.parent.as_posix() in packages, file
        patterns = ["*.py", *packages[file.parent.as_posix()]]
        assert any(fnmatch(file.name, pattern) for pattern in patterns), file
