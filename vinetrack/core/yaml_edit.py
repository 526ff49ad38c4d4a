"""Setting or clearing a key of a YAML file in place, without changing any other character, comments included."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from vinetrack.core.problems import ExperimentError
from vinetrack.core.yaml_document import parse_yaml, top_level_value, verify_edit

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
