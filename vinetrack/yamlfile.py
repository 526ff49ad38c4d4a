"""YAML as people expect it: a key twice is an error, 10:20 is text, and every key knows its line."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from vinetrack.problems import ExperimentError, Problem
from vinetrack.tables import TableError, read_text

MOST_KEYS = 10_000


@dataclass(frozen=True)
class YamlDocument:
    """Content of a YAML file; `lines` maps the path to each key, as a tuple, to its line from 1."""

    content: Any
    lines: dict[tuple[Any, ...], int]


class _Loader(yaml.SafeLoader):
    """Safe loader without YAML 1.1's surprises: no base-60 numbers (10:20), octals (010), dates or underscores."""


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
    """Read a YAML file that holds one mapping; an empty file is an empty mapping.

    Raises
    ------
    ExperimentError
        If it cannot be read, is not YAML, holds no mapping or holds a key twice.
    """
    try:
        text = read_text(path)
    except TableError as error:
        message, _, remedy = str(error).partition(": ")
        raise ExperimentError([Problem(message=message, file=path.name, remedy=remedy)]) from None
    return parse_yaml(text, path.name)


def parse_yaml(text: str, file: str) -> YamlDocument:
    r"""Parse YAML text; see `read_yaml`.

    >>> parse_yaml("steady: 10:20\ncapture_fps: 1e3", "experiment.yaml").content
    {'steady': '10:20', 'capture_fps': 1000.0}
    """
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
    """Note the line of every key below a node, and every key that is written twice."""
    # Aliases of aliases can stand for more keys than memory holds; no settings come near either limit.
    if len(path) > 20 or len(lines) > MOST_KEYS:
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
        for i, item in enumerate(node.value):
            lines[(*path, i)] = item.start_mark.line + 1
            _walk(item, (*path, i), lines, repeated, file)


def _syntax_problem(error: Exception, file: str) -> Problem:
    """Where and why the text is not YAML, in one sentence."""
    mark = getattr(error, "problem_mark", None)
    reason = getattr(error, "problem", None) or "it cannot be understood"
    remedy = "use spaces (no tabs) to indent, a blank after each colon, and quotes round text that holds : or #"
    line = mark.line + 1 if mark is not None else 0
    return Problem(message=f"is not YAML ({reason})", file=file, line=line, remedy=remedy)
