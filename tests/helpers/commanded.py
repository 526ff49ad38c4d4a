"""Commands of vinetrack, run in this process."""

from click.testing import Result
from typer.testing import CliRunner

from vinetrack.cli.main import app


def run(*arguments: object) -> Result:
    """Run a command; its output, and its exit code."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)


def succeed(*arguments: object) -> str:
    """Run a command that must succeed; its output."""
    done = run(*arguments)
    assert done.exit_code == 0, done.output
    return done.output
