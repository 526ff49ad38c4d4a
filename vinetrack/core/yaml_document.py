"""Reading YAML: repeated keys are errors, 10:20 is text, lines of keys are known; and edits that keep comments."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.tables import TableError, read_text


@dataclass(frozen=True)
class YamlDocument:
    """Content of a YAML file; `lines` maps the path of each key, as a tuple, to its line, from 1."""

    content: Any
    lines: dict[tuple[Any, ...], int]


def read_yaml(path: Path) -> YamlDocument:
    """Read a YAML file that holds one mapping; an empty file is an empty mapping."""
    try:
        text = read_text(path)
    except TableError as error:
        raise ExperimentError([Problem.from_error(error, path.name)]) from None
    return parse_yaml(text, path.name)


def parse_yaml(text: str, file: str) -> YamlDocument:
    """Parse YAML text; see `read_yaml`."""
    from ruamel.yaml.error import YAMLError

    lines: dict[tuple[Any, ...], int] = {}
    repeated: list[Problem] = []
    try:
        _walk(_round_trip().compose(text), (), lines, repeated, file)
        content = {} if repeated else _plain(_round_trip().load(text))
    except (YAMLError, RecursionError, ValueError, ArithmeticError, TypeError, LookupError, AttributeError) as error:
        raise ExperimentError([_syntax_problem(error, file)]) from None
    content = {} if content is None else content
    if repeated:
        raise ExperimentError(repeated)
    if not isinstance(content, dict):
        remedy = "write lines such as 'key: value'"
        raise ExperimentError([Problem(message="holds no settings", file=file, remedy=remedy)])
    return YamlDocument(content, lines)


def _round_trip() -> Any:
    from ruamel.yaml import YAML

    document = YAML()
    document.preserve_quotes, document.width = True, 10_000
    return document


def _walk(
    node: Any, path: tuple[Any, ...], lines: dict[tuple[Any, ...], int], repeated: list[Problem], file: str
) -> None:
    """Record the line of every key below a node in `lines`, and every repeated key in `repeated`."""
    from ruamel.yaml.nodes import MappingNode, SequenceNode

    # 10_000, 20: largest document (chosen): nested aliases can expand beyond the memory
    if len(path) > 20 or len(lines) > 10_000:
        raise ValueError("too large")
    if isinstance(node, MappingNode):
        for key_node, value_node in node.value:
            line = key_node.start_mark.line + 1
            key = (*path, key_node.value if isinstance(key_node.value, str) else "?")
            if key in lines and key_node.value != "<<":
                remedy = f"keep one; the first is on line {lines[key]}"
                dotted = ".".join(str(part) for part in key)
                repeated.append(Problem(message="is set twice", file=file, line=line, column=dotted, remedy=remedy))
            lines[key] = line
            _walk(value_node, key, lines, repeated, file)
    elif isinstance(node, SequenceNode):
        for i, element in enumerate(node.value):
            lines[(*path, i)] = element.start_mark.line + 1
            _walk(element, (*path, i), lines, repeated, file)


def _syntax_problem(error: Exception, file: str) -> Problem:
    """Return the problem of a text that is not YAML, with its line."""
    mark = getattr(error, "problem_mark", None)
    reason = getattr(error, "problem", None) or "it cannot be understood"
    remedy = "use spaces (no tabs) to indent, a space after each colon, and quotes around text that contains : or #"
    line = mark.line + 1 if mark is not None else 0
    return Problem(message=f"is not YAML ({reason})", file=file, line=line, remedy=remedy)


def with_value(text: str, key: str, value: Any, file: str = "experiment.yaml") -> str:
    """Return the text with a top-level key set to a value; everything else is kept, comments included."""
    from ruamel.yaml.util import load_yaml_guess_indent

    before = parse_yaml(text, file).content
    wanted = {**before, key: _plain(value)}
    if key in before and before == wanted:
        return text
    document = _round_trip()
    out = io.StringIO()
    if before:
        tree, indent, offset = load_yaml_guess_indent(text)
        tree[key] = _edited(tree.get(key), value)
        if indent is not None and offset is not None:
            document.indent(mapping=2, sequence=indent, offset=offset)
        document.dump(tree, out)
        comments = [line for line in text.splitlines() if line.strip().startswith("#")]
        lost = [line for line in comments if line.strip() not in out.getvalue()]
        changed = out.getvalue() + "".join(f"{line}\n" for line in lost)  # comments below a block that is gone
    else:
        document.dump({key: _edited(None, value)}, out)
        changed = text + ("\n" if text and not text.endswith("\n") else "") + out.getvalue()
    try:
        correct = parse_yaml(changed, file).content == wanted
    except ExperimentError:
        correct = False
    if not correct:
        message, remedy = "cannot be changed without altering other settings", f"set it by hand: {key}: {value}"
        raise ExperimentError([Problem(message=message, file=file, column=key, remedy=remedy)])
    return changed


def _edited(old: Any, value: Any) -> Any:
    """Return a value in the form of the one it replaces, so that comments stay at what is kept."""
    from ruamel.yaml.comments import CommentedMap, CommentedSeq

    if isinstance(value, Mapping):
        tree = old if isinstance(old, CommentedMap) else CommentedMap()
        for name in [name for name in tree if name not in value]:
            del tree[name]
        for name, inner in value.items():
            if name not in tree or _plain(tree[name]) != _plain(inner):
                tree[name] = _edited(tree.get(name), inner)
        return tree
    if isinstance(value, Sequence) and not isinstance(value, str):
        elements = old if isinstance(old, CommentedSeq) else CommentedSeq()
        if elements is not old:
            elements.fa.set_flow_style()
        for i in reversed(range(len(elements))):
            if _plain(elements[i]) not in value:
                del elements[i]
        if _plain(elements) != _plain(value[: len(elements)]):
            elements.clear()
        elements.extend(_edited(None, element) for element in value[len(elements) :])
        return elements
    return value


def _plain(value: Any) -> Any:
    """Return a value in Python's own types, as YAML would load it."""
    if isinstance(value, Mapping):
        return {_plain(name): _plain(inner) for name, inner in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(inner) for inner in value]
    return next((kind(value) for kind in (bool, int, float, str) if isinstance(value, kind)), value)
