"""Notebooks run without a server: their code cells one after the other, and what each shows.
`python tests/helpers/notebook.py docs/python.ipynb` runs one and writes its outputs into it.
"""

import ast
import base64
import contextlib
import io
import json
import sys
from pathlib import Path

from matplotlib.figure import Figure

DPI = 55  # Of pictures in a stored notebook. Chosen: about 30 kB each


def run(path: Path) -> list[list[dict]]:
    """Run the code cells of a notebook in one namespace; what each printed and showed, as `nbformat` 4 has it."""
    names: dict = {"__name__": "__main__"}
    notebook = json.loads(path.read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4
    return [_run_cell("".join(cell["source"]), names) for cell in notebook["cells"] if cell["cell_type"] == "code"]


def _run_cell(source: str, names: dict) -> list[dict]:
    tree = ast.parse(source)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    printed, value = io.StringIO(), None
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, "cell", "exec"), names)
        if last is not None:
            value = eval(compile(ast.Expression(last.value), "cell", "eval"), names)
    outputs: list[dict] = []
    if text := printed.getvalue().splitlines(keepends=True):
        outputs.append({"output_type": "stream", "name": "stdout", "text": text})
    if value is not None:
        data: dict = {"text/plain": repr(value).splitlines(keepends=True)}
        if isinstance(value, Figure):
            file = io.BytesIO()
            value.savefig(file, format="png", dpi=DPI, facecolor="white")
            data = {"text/plain": ["<Figure>"], "image/png": base64.b64encode(file.getvalue()).decode()}
        elif hasattr(value, "_repr_html_"):
            data["text/html"] = value._repr_html_().splitlines(keepends=True)
        outputs.append({"output_type": "execute_result", "execution_count": None, "metadata": {}, "data": data})
    return outputs


if __name__ == "__main__":
    for path in map(Path, sys.argv[1:]):
        notebook = json.loads(path.read_text(encoding="utf-8"))
        code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
        for count, (cell, outputs) in enumerate(zip(code, run(path), strict=True), 1):
            numbered = [one | {"execution_count": count} if "execution_count" in one else one for one in outputs]
            cell.update(execution_count=count, outputs=numbered)
        path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
