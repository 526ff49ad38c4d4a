"""Edits of `experiment.yaml` that keep everything else as it is, comments included."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.tables import parse_yaml, read_text, write_bytes
from vinetrack.experiment.folder import SETTINGS
from vinetrack.experiment.settings import read_experiment_settings


def save_model(folder: Path, names: Sequence[str], files: Sequence[str] = ()) -> Path:
    """Set `model:` in `experiment.yaml`, its byte-order mark and line ends kept, and add files to `effects:`; return
    the path.
    """
    path, mark = folder / SETTINGS, b"\xef\xbb\xbf"
    before = path.read_bytes() if path.exists() else b""
    text = read_text(path) if before else ""
    listed = list(read_experiment_settings(path).effects)
    if new := [name for name in files if name not in listed]:
        text = with_value(text, "effects", [*listed, *new], path.name)
    text = with_value(text, "model", names, path.name)
    if b"\r\n" in before:
        text = text.replace("\n", "\r\n")
    write_bytes(path, (mark if before.startswith(mark) else b"") + text.encode("utf-8"))
    return path


def with_value(text: str, key: str, value: Any, file: str = SETTINGS) -> str:
    """Return the text with a top-level key set to a value; everything else is kept, comments included."""
    from ruamel.yaml import YAML
    from ruamel.yaml.util import load_yaml_guess_indent

    before, value = parse_yaml(text, file).content, json.loads(json.dumps(value))
    if key in before and before[key] == value:
        return text
    document, out = YAML(), io.StringIO()
    document.preserve_quotes, document.width = True, 10_000
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
    with contextlib.suppress(ExperimentError):
        if parse_yaml(changed, file).content == {**before, key: value}:
            return changed
    message, remedy = "cannot be changed without altering other settings", f"set it by hand: {key}: {value}"
    raise ExperimentError([Problem(message=message, file=file, column=key, remedy=remedy)])


def _edited(old: Any, value: Any) -> Any:
    """Return a value in the form of the one it replaces, so that comments stay at what is kept."""
    from ruamel.yaml.comments import CommentedMap, CommentedSeq

    if isinstance(value, dict):
        tree = old if isinstance(old, CommentedMap) else CommentedMap()
        for name in tree.keys() - value.keys():
            del tree[name]
        for name, inner in value.items():
            if name not in tree or tree[name] != inner:
                tree[name] = _edited(tree.get(name), inner)
        return tree
    if isinstance(value, list):
        elements = old if isinstance(old, CommentedSeq) else CommentedSeq()
        if elements is not old:
            elements.fa.set_flow_style()
        for i in reversed(range(len(elements))):
            if elements[i] not in value:
                del elements[i]
        if elements != value[: len(elements)]:
            elements.clear()
        elements.extend(_edited(None, element) for element in value[len(elements) :])
        return elements
    return value
