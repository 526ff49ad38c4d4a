"""Prose stands in one room: every code has its sentence, and nothing outside cuts a sentence up to learn from it."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import vinetrack
from vinetrack.diagnosis.result import BETWEEN_SUMMARIES
from vinetrack.narrative import SENTENCES
from vinetrack.narrative.diagnosis_text import REMARKS
from vinetrack.narrative.verdict_text import BETWEEN_REMEDIES

PACKAGE = Path(vinetrack.__file__).parent
FILES = [path for path in PACKAGE.rglob("*.py") if path.relative_to(PACKAGE).parts[0] != "narrative"]
TOLD = {"reason", "explanation", "note", "sentence", "words", "why", "answer", "question"}
"""Names of what holds a sentence."""
CUTS = {"startswith", "endswith", "partition", "rpartition", "removesuffix", "removeprefix", "find", "index"}


def name_of(node: ast.AST) -> str:
    """What an expression is called: `row.reason`, `note`, `str(error.reason)`, `estimate_text(…)`."""
    if isinstance(node, ast.Call):
        is_text = isinstance(node.func, ast.Name) and node.func.id == "str" and bool(node.args)
        return name_of(node.args[0] if is_text else node.func)
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def is_told(node: ast.AST) -> bool:
    return name_of(node) in TOLD or (isinstance(node, ast.Call) and name_of(node).endswith("_text"))


def cuts_prose(node: ast.AST) -> bool:
    """Whether it looks for constant words in a sentence."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in CUTS:
        constant = bool(node.args) and isinstance(node.args[0], ast.Constant)
        return constant and is_told(node.func.value)
    if isinstance(node, ast.Compare) and isinstance(node.ops[0], ast.In | ast.NotIn):
        return isinstance(node.left, ast.Constant) and isinstance(node.left.value, str) and is_told(node.comparators[0])
    return False


def test_no_module_outside_the_room_of_prose_parses_it():
    cut = [
        (str(path.relative_to(PACKAGE)), ast.unparse(node)[:90])
        for path in FILES
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if cuts_prose(node)
    ]
    assert cut == []


def test_every_code_has_a_sentence_every_sentence_a_code_and_every_difference_a_remedy():
    makers = ("inference", "diagnosis", "planning", "pipeline")
    source = "".join(path.read_text(encoding="utf-8") for path in FILES if path.parent.name in makers)
    assert set(re.findall(r'\b[Rr]emark\(\s*["\'](\w+)["\']', source)) <= SENTENCES.keys() | REMARKS.keys()
    assert [code for code in (*SENTENCES, *REMARKS) if not re.search(rf"""["']{code}["']""", source)] == []
    assert BETWEEN_REMEDIES.keys() == BETWEEN_SUMMARIES.keys()
