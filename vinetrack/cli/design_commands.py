"""The commands about vines not yet built: `vinetrack predict` and `vinetrack design …`."""

from __future__ import annotations

import typer

from vinetrack.cli.campaign_command import campaign
from vinetrack.cli.predict_command import predict
from vinetrack.cli.vine_commands import reservoir, vine

design_app = typer.Typer(
    name="design",
    help="The fastest vine, the reservoir it needs, the campaign that pins n and B.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
design_app.command()(vine)
design_app.command()(reservoir)
design_app.command()(campaign)


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command()(predict)
    app.add_typer(design_app)
