"""docs/architecture.md names files and classes that exist."""

import re
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]


def test_files_and_classes_that_the_page_names_exist():
    page = (REPOSITORY / "docs" / "architecture.md").read_text()
    words = set(re.findall(r"`([\w./-]+)`", re.sub(r"^```.*?^```$", "", page, flags=re.M | re.S)))
    folders = ("chsel", "conf", "replay", "runners", "tests")
    files = [file for folder in folders for file in (REPOSITORY / folder).rglob("*.*")]
    paths = {"/" + file.relative_to(REPOSITORY).as_posix() for file in files}
    named = {word for word in words if word.endswith((".py", ".yaml", ".json"))}
    assert len(named) > 30
    assert {word for word in named if not any(path.endswith("/" + word) for path in paths)} == set()
    text = "".join(file.read_text() for file in files if file.suffix == ".py")
    classes = {word for word in words if re.fullmatch(r"(?:[A-Z][a-z0-9]+){2,}", word)}
    assert len(classes) > 8
    assert {word for word in classes if not re.search(rf"\b{word}\b", text)} == set()
