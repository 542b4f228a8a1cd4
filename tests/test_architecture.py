"""The documents for newcomers name files and functions that the sources have."""

import ast
import re

import pytest
from house import ROOT

PAGES = ("ARCHITECTURE", "DECISIONS", "GLOSSARY")
OTHERS = ("METHOD", "CONVENTIONS", "TOOLS")  # which name folders of users too
FOLDERS = ("piccolo", "research", "tests", "tools", "page/src")
SOURCES = [
    path for name in FOLDERS for path in (ROOT / name).rglob("*.*") if "node_modules" not in path.parts
]
PATHS = [
    path.relative_to(ROOT).as_posix() for path in [*SOURCES, *ROOT.glob("*.py"), *ROOT.glob("docs/*.json")]
]
FOLDER_NAMES = {f"{parent.as_posix()}/" for path in SOURCES for parent in path.relative_to(ROOT).parents}
DEFINED = (ast.FunctionDef, ast.ClassDef)


def _read(name):
    return (ROOT / "docs" / f"{name}.md").read_text()


def _find(path):
    """The paths that end in one as a document has it; `...` stands for any part of a name."""
    pattern = re.compile(rf"(?:.*/)?{re.escape(path).replace(re.escape('...'), '[^/]*')}")
    return [known for known in PATHS if pattern.fullmatch(known)]


def _list_names(path):
    """Functions, classes, methods, constants and fields that a source defines."""
    for node in ast.walk(ast.parse((ROOT / path).read_text())):
        if isinstance(node, DEFINED):
            yield node.name
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id


@pytest.mark.parametrize("name", [*PAGES, *OTHERS])
def test_files_exist(name):
    files = re.findall(r"`([\w./]+\.(?:py|ts|schema\.json))`", _read(name))
    assert files or name == "GLOSSARY"
    assert [path for path in files if not _find(path)] == []


@pytest.mark.parametrize("name", PAGES)
def test_folders_exist(name):
    folders = re.findall(r"`([\w./]+/)`", _read(name))
    gone = [word for word in folders if not any(f"/{known}".endswith(f"/{word}") for known in FOLDER_NAMES)]
    assert gone == []


@pytest.mark.parametrize("name", PAGES)
def test_a_function_is_in_the_file_that_is_named_with_it(name):
    """`name` (`path.py`), and `NAMES` of `path.py`."""
    pairs = re.findall(r"`([\w.]+)`(?: \(|\s+of\s+)`([\w./]+\.py)`", _read(name))
    assert pairs or name == "GLOSSARY"
    gone = []
    for function, path in pairs:
        defined = {known for file in _find(path) for known in _list_names(file)}
        gone += [(function, path)] * (function.split(".")[-1] not in defined)
    assert gone == []


@pytest.mark.parametrize("name", PAGES)
def test_all_names_are_defined_somewhere(name):
    words = re.findall(r"`([A-Za-z_.]+)`", _read(name))
    words = [word for word in words if "..." not in word and not re.search(r"\.(py|ts|json)$", word)]
    text = "\n".join((ROOT / path).read_text() for path in PATHS if path.endswith((".py", ".ts")))
    known = {*re.findall(r"\w+", text), "formats"}  # the extra
    assert [word for word in words if not set(word.split(".")) <= known] == []


def _benchmark_rows(pattern):
    """Queries, right, localized, wrong and outside of rows of BENCHMARK.md."""
    text = (ROOT / "BENCHMARK.md").read_text()
    rows = re.findall(rf"^\| (?:{pattern})" + r" \| (\d+)" * 5, text, flags=re.MULTILINE)
    return [sum(map(int, column)) for column in zip(*rows, strict=True)]


def test_limitations_are_those_of_the_benchmark():
    section = _read("METHOD").partition("## Limitations")[2].partition("\n## ")[0]
    wrong, queries = re.search(
        r"^(\d+) of (\d+) were localized and are not right", (ROOT / "BENCHMARK.md").read_text(), re.MULTILINE
    ).groups()
    assert (wrong, f"Of {queries} none" in section) == ("0", True)
    assert _benchmark_rows("60% hidden by objects")[::2] == [12, 9, 0], "a quarter is not found"
    assert _benchmark_rows("masked outside of 65 deg")[::2] == [12, 9, 0], "a quarter is not found"
    queries, _, localized, _, _ = _benchmark_rows(r"h\w+, (?:exact focal length|focal length by EXIF)")
    assert round(1 - localized / queries, 1) == 0.3, "three of ten are not found"
    assert _benchmark_rows(r"h\w+, photo")[::4] == [12, 4]
    assert _benchmark_rows("corridor, own photos")[2::2] == [5, 4]
