"""Reading YAML without its surprises: repeated keys are errors, 10:20 is text, and the line of every key is known."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.tables import TableError, read_text

MAX_KEYS = 10_000  # Largest number of keys of a document (chosen)


@dataclass(frozen=True)
class YamlDocument:
    """Content of a YAML file; `lines` maps the path of each key, as a tuple, to its line, from 1."""

    content: Any
    lines: dict[tuple[Any, ...], int]


class _Loader(yaml.SafeLoader):
    """Safe loader without the base-60 numbers (10:20), octal numbers, dates and underscores of YAML 1.1."""


_Loader.yaml_implicit_resolvers = {
    first: [pair for pair in pairs if pair[0] in ("tag:yaml.org,2002:bool", "tag:yaml.org,2002:null")]
    for first, pairs in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver("tag:vinetrack,number", re.compile(r"^[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?$"), None)
_Loader.add_implicit_resolver("tag:yaml.org,2002:merge", re.compile(r"^<<$"), ["<"])


def _construct_number(loader: yaml.SafeLoader, node: Any) -> int | float | str:
    text = str(loader.construct_scalar(node))
    if re.fullmatch(r"[+-]?\d{1,18}", text):
        return int(text)
    value = float(text)
    return value if abs(value) != float("inf") else text


_Loader.add_constructor("tag:vinetrack,number", _construct_number)


def read_yaml(path: Path) -> YamlDocument:
    """Read a YAML file that holds one mapping; an empty file is an empty mapping."""
    try:
        text = read_text(path)
    except TableError as error:
        raise ExperimentError([Problem.from_error(error, path.name)]) from None
    return parse_yaml(text, path.name)


def parse_yaml(text: str, file: str) -> YamlDocument:
    r"""Parse YAML text; see `read_yaml`."""
    loader = None
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        lines: dict[tuple[Any, ...], int] = {}
        repeated: list[Problem] = []
        _walk(node, (), lines, repeated, file)
        content = loader.construct_document(node) if node is not None else {}
    except (yaml.YAMLError, RecursionError, ValueError, OverflowError, TypeError) as error:
        raise ExperimentError([_syntax_problem(error, file)]) from None
    finally:
        if loader is not None:
            loader.dispose()
    content = {} if content is None else content
    if repeated:
        raise ExperimentError(repeated)
    if not isinstance(content, dict):
        raise ExperimentError(
            [Problem(message="holds no settings", file=file, remedy="write lines such as 'key: value'")]
        )
    return YamlDocument(content, lines)


def _walk(
    node: Any, path: tuple[Any, ...], lines: dict[tuple[Any, ...], int], repeated: list[Problem], file: str
) -> None:
    """Record the line of every key below a node in `lines`, and every repeated key in `repeated`."""
    # Nested aliases can expand to more keys than fit into memory; real settings are far below both limits.
    if len(path) > 20 or len(lines) > MAX_KEYS:
        raise ValueError("too large")
    if isinstance(node, yaml.MappingNode):
        for key_node, value_node in node.value:
            line = key_node.start_mark.line + 1
            key = (*path, key_node.value if isinstance(key_node, yaml.ScalarNode) else "?")
            if key in lines and key_node.tag != "tag:yaml.org,2002:merge":
                remedy = f"keep one; the first is on line {lines[key]}"
                dotted = ".".join(str(part) for part in key)
                repeated.append(Problem(message="is set twice", file=file, line=line, column=dotted, remedy=remedy))
            lines[key] = line
            _walk(value_node, key, lines, repeated, file)
    elif isinstance(node, yaml.SequenceNode):
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


def with_list(text: str, key: str, values: Sequence[str], file: str = "experiment.yaml") -> str:
    r"""Return the text with a top-level key set to a list of words; everything else, comments included, is unchanged. A
    list in brackets stays in brackets, and a list with one line per value stays so; comments after the value and
    between its lines are kept. A missing key is added at the end.
    """
    before = parse_yaml(text, file).content
    flow = f"[{', '.join(values)}]"
    node = top_level_value(text, key)
    if node is None:
        gap = "" if not text or text.endswith("\n") else "\n"
        changed = f"{text}{gap}{key}: {flow}\n"
    elif isinstance(node, yaml.SequenceNode) and not node.flow_style:
        changed = _with_block_items(text, node, values)
    else:
        begin, end = node.start_mark.index, node.end_mark.index
        changed = text[:begin] + (" " if begin == end else "") + flow + text[end:]
    verify_edit(changed, {**before, key: list(values)}, key, flow, file)
    return changed


def verify_edit(changed: str, expected: dict[Any, Any], key: str, shown: str, file: str) -> None:
    """Check that an edited text has exactly the expected content."""
    try:
        correct = parse_yaml(changed, file).content == expected
    except ExperimentError:
        correct = False
    if not correct:
        remedy = f"set it by hand: {key}: {shown}"
        raise ExperimentError(
            [Problem(message="cannot be changed without altering other settings", file=file, column=key, remedy=remedy)]
        )


def top_level_value(text: str, key: str) -> Any:
    """Return the node of a top-level key's value, with its position in the text."""
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
    finally:
        loader.dispose()
    pairs = node.value if isinstance(node, yaml.MappingNode) else []
    return next((value for name, value in pairs if getattr(name, "value", None) == key), None)


def _with_block_items(text: str, node: Any, values: Sequence[str]) -> str:
    """Set a list with one line per value: drop the lines of removed values, add new ones after the last that is kept.
    If the order of the kept values changes, all lines are replaced.
    """
    lines = text.splitlines(keepends=True)
    items = [(element.start_mark.line, str(getattr(element, "value", ""))) for element in node.value]
    indent = " " * node.start_mark.column
    line_of = {value: line for line, value in items}
    dropped_lines = {line for line, value in items if value not in values}
    kept_values = [value for value in values if value in line_of]
    keeps_order = [value for _, value in items if value in values] == kept_values
    if not keeps_order or list(values[: len(kept_values)]) != kept_values:
        dropped_lines, kept_values = set(line_of.values()), []
    new_lines = [f"{indent}- {value}\n" for value in values[len(kept_values) :]]
    insert_after = max((line_of[value] for value in kept_values), default=node.start_mark.line - 1)
    result: list[str] = []
    for number, line in enumerate(lines):
        if number not in dropped_lines:
            result.append(line if line.endswith("\n") or number < len(lines) - 1 else line + "\n")
        if number == insert_after:
            result += new_lines
    return "".join(result if insert_after >= 0 else [*new_lines, *result])


# ------------------------------------------------------------------------------
# Setting or clearing a key of a YAML file in place, without changing any other character, comments included.

_PLAIN_TEXT = re.compile(r"[A-Za-z_./][\w./ -]*")
_YAML_WORDS = frozenset({"yes", "no", "true", "false", "on", "off", "null", "y", "n"})
_Edit = tuple[int, int, str]  # Start index, end index, and the text that replaces what lies between


def with_value(text: str, key: str, value: Any, file: str = "experiment.yaml") -> str:
    r"""Return the text with a top-level key set to a value; everything else is unchanged."""
    before = parse_yaml(text, file).content
    if before.get(key) == _plain(value):
        return text
    node = top_level_value(text, key)
    if node is None:
        gap = "" if not text or text.endswith("\n") else "\n"
        changed = f"{text}{gap}{_new_lines(key, value)}"
    else:
        changed = text
        for begin, end, new in sorted(_edits(text, node, value), reverse=True):
            changed = changed[:begin] + new + changed[end:]
    verify_edit(changed, {**before, key: _plain(value)}, key, _inline(value), file)
    return changed


def _edits(text: str, node: Any, value: Any) -> list[_Edit]:
    """Return the edits that replace the value at a node."""
    is_block = isinstance(node, yaml.CollectionNode) and not node.flow_style
    if isinstance(value, Mapping) and is_block and isinstance(node, yaml.MappingNode):
        return _mapping_edits(text, node, value)
    if is_block:
        return [_lines_of(text, node.value[0], node)] if value is None and node.value else []
    begin, end = node.start_mark.index, node.end_mark.index
    if isinstance(value, Mapping) and begin == end:
        # The key is blank: insert the lines of the mapping after the end of the line, which may hold a comment.
        after = text.find("\n", begin)
        lines = "".join(f"\n  {name}: {_inline(inner)}" for name, inner in value.items())
        return [(after, after, lines) if after >= 0 else (len(text), len(text), lines + "\n")]
    if value is None:
        # Remove the space before the value as well.
        return [(begin - 1 if begin < end and text[begin - 1] == " " else begin, end, "")]
    return [(begin, end, (" " if begin == end else "") + _inline(value))]


def _mapping_edits(text: str, node: Any, value: Mapping[str, Any]) -> list[_Edit]:
    """Return the edits of a mapping with one line per key."""
    edits: list[_Edit] = []
    present = {}
    for name, inner in node.value:
        present[name.value] = inner
        if name.value not in value:
            edits.append(_lines_of(text, name, inner))
        elif _differs(text, inner, value[name.value]):
            edits += _edits(text, inner, value[name.value])
    new = [name for name in value if name not in present]
    if new:
        indent = " " * node.value[0][0].start_mark.column
        begin = _line_start(text, _last_line(node.value[-1][1]) + 1)
        gap = "" if begin == 0 or text[begin - 1] == "\n" else "\n"
        lines = "".join(f"{indent}{name}: {_inline(value[name])}\n" for name in new)
        edits.append((begin, begin, gap + lines))
    return edits


def _differs(text: str, node: Any, value: Any) -> bool:
    """Whether the value at a node differs from `value`."""
    shown = text[node.start_mark.index : node.end_mark.index]
    try:
        return bool(parse_yaml(f"v: {shown}\n", "").content["v"] != _plain(value))
    except ExperimentError:
        return True


def _lines_of(text: str, first: Any, last: Any) -> _Edit:
    """Return an edit that removes the lines from one node (or pair of nodes) to another."""
    start = first[0] if isinstance(first, tuple) else first
    return _line_start(text, start.start_mark.line), _line_start(text, _last_line(last) + 1), ""


def _last_line(node: Any) -> int:
    """Return the last line, from 0, of a node's content; the end mark of a block lies after comments that follow it."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _last_line(last[1] if isinstance(last, tuple) else last)
    return int(node.end_mark.line)


def _line_start(text: str, line: int) -> int:
    index = 0
    for _ in range(line):
        index = text.find("\n", index) + 1
        if index == 0:
            return len(text)
    return index


def _new_lines(key: str, value: Any) -> str:
    if isinstance(value, Mapping):
        return f"{key}:\n" + "".join(f"  {name}: {_inline(inner)}\n" for name, inner in value.items())
    return f"{key}: {_inline(value)}\n" if value is not None else f"{key}:\n"


def _inline(value: Any) -> str:
    """Write a value on one line."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{name}: {_inline(inner)}" for name, inner in value.items()) + "}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return f"[{', '.join(map(_inline, value))}]"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int | float):
        return f"{value:.15g}"
    text = "" if value is None else str(value)
    plain = _PLAIN_TEXT.fullmatch(text) and text.strip() == text and text.lower() not in _YAML_WORDS
    return text if plain else json.dumps(text, ensure_ascii=False)


def _plain(value: Any) -> Any:
    """Return the value as YAML would load it: tuples become lists."""
    if isinstance(value, Mapping):
        return {name: _plain(inner) for name, inner in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(inner) for inner in value]
    return value
