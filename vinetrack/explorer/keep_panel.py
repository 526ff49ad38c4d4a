"""Save the model, take the figure and the numbers along, and say what to type for the same."""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import TYPE_CHECKING

from bokeh.models import Button, Column, ColumnDataSource, CustomJS, Row

from vinetrack.core.problems import ExperimentError, format_problems
from vinetrack.core.tables import TableError
from vinetrack.explorer.export import commands, exported, model_words
from vinetrack.explorer.look import command_block, escaped, sheet, words
from vinetrack.pipeline.source_experiment import save_model

if TYPE_CHECKING:
    from vinetrack.explorer.page import Page

MIME = {"csv": "text/csv", "svg": "image/svg+xml", "png": "image/png"}
DOWNLOAD = """
const [name, mime, body] = ["name", "mime", "body"].map((key) => cb_obj.data[key][0]);
if (!name) return;
const bytes = Uint8Array.from(atob(body), (char) => char.charCodeAt(0));
const link = document.createElement("a");
link.href = URL.createObjectURL(new Blob([bytes], {type: mime}));
link.download = name;
link.click();
setTimeout(() => URL.revokeObjectURL(link.href), 1000);
"""
GAP = ":host { gap: 6px; flex-wrap: wrap; }"


class KeepPanel:
    """Buttons of one page."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self.save = Button(label="Save the model to experiment.yaml", name="save", stylesheets=[sheet()], margin=0)
        self.save.on_click(self._save)
        self.said = words(name="saved")
        self._download = ColumnDataSource({"name": [""], "mime": [""], "body": [""]}, name="download")
        self._download.js_on_change("data", CustomJS(code=DOWNLOAD))
        forms = {"svg": "Figure (SVG)", "png": "Figure (PNG)", "csv": "Data (CSV)"}
        buttons = [self._button(form, label) for form, label in forms.items()]
        self.root = Column(
            children=[
                Row(children=[self.save], margin=0),
                self.said,
                Row(children=buttons, margin=0, stylesheets=[sheet(GAP)]),
                words("<small>Figure and data hold the trials that are shown, as the model has them now.</small>"),
            ],
            sizing_mode="stretch_width",
            name="keep",
            margin=0,
            tags=[self._download],
        )

    def _button(self, form: str, label: str) -> Button:
        button = Button(label=label, name=f"export_{form}", stylesheets=[sheet()], margin=0)
        button.on_click(self._exporter(form))
        return button

    def _exporter(self, form: str) -> Callable[[], None]:
        def give() -> None:
            page = self._page
            if page.curves is None:
                return
            data = exported(page.campaign, page.choice, page.curves, page.chooser.shown, form)
            body = base64.b64encode(data).decode("ascii")
            name = f"{page.campaign.name}_explorer.{form}"
            self._download.data = {"name": [name], "mime": [MIME[form]], "body": [body]}

        return give

    def _save(self) -> None:
        page = self._page
        folder = page.campaign.experiment.folder
        try:
            path = save_model(folder, page.choice.effects)
        except (ExperimentError, TableError, OSError) as error:
            lines = format_problems(error.problems) if isinstance(error, ExperimentError) else [str(error)]
            self.said.text = f'<p class="bad">{escaped("; ".join(lines))}</p>'
            return
        rerun = f"snakemake --cores 2 --config experiment={folder.as_posix()}"
        self.said.text = (
            f'<p><span class="good">Saved.</span> {escaped(path.as_posix())} now has the'
            f" {escaped(model_words(page.choice.effects))}. The same:</p>"
            f"{command_block(self._lines(save=True))}<p>New tables and report by</p>{command_block([rerun])}"
        )

    def _lines(self, *, save: bool = False) -> list[str]:
        page = self._page
        start = page.ground.start
        return commands(page.campaign, start, page.choice, fitted=page.is_fitted(), save=save)

    def commands(self) -> str:
        """What to type for what is on the page."""
        return command_block(self._lines())
