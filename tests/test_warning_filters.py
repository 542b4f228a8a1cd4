"""The filters of warnings belong to the whole process: nothing that threads do changes them."""

import ast
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "piccolo"
CHANGES = {"catch_warnings", "simplefilter", "resetwarnings"}


def test_no_function_changes_the_filters_of_warnings():
    found = [
        f"{path.relative_to(PACKAGE)}:{node.lineno}"
        for path in PACKAGE.rglob("*.py")
        for function in ast.walk(ast.parse(path.read_text()))
        if isinstance(function, ast.FunctionDef)
        for node in ast.walk(function)
        if getattr(node, "attr", getattr(node, "id", "")) in {*CHANGES, "filterwarnings"}
    ]
    assert found == []
