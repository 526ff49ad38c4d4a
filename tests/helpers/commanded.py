"""Commands of vinetrack, run in this process."""

from __future__ import annotations

from click.testing import Result
from typer.testing import CliRunner

from vinetrack.cli.main import app
from vinetrack.experiment.folder import read_experiment
from vinetrack.experiment.settings import run_settings
from vinetrack.pipeline.stages import Job
from vinetrack.pipeline.trials import fit_damping


def run(*arguments: object) -> Result:
    """Run a command; its output, and its exit code."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments], catch_exceptions=False)


def succeed(*arguments: object) -> str:
    """Run a command that must succeed; its output."""
    done = run(*arguments)
    assert done.exit_code == 0, done.output
    return done.output


def fit_law(experiment, results, **settings) -> list[str]:
    """The first part of the stage of the model: trials gathered, and the damping law fitted to them."""
    return fit_damping(Job(read_experiment(experiment), results, run_settings(settings)))
