"""Commands of vinetrack, run in this process; and those that a page shows with what they print, as `$ vinetrack …`."""

import re
import shlex
from collections.abc import Container
from dataclasses import dataclass

from click.testing import Result
from typer.testing import CliRunner

from vinetrack.cli.main import app
from vinetrack.experiment.folder import read_experiment
from vinetrack.experiment.settings import run_settings
from vinetrack.pipeline.analysis import fit_damping
from vinetrack.pipeline.workflow import Job


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


INDENT = "    "
PROMPT = f"{INDENT}$ "


@dataclass(frozen=True)
class Shown:
    """One command of a page: its lines as they stand there, its arguments, and the output shown below it."""

    lines: tuple[str, ...]
    arguments: tuple[str, ...]
    output: str


def pieces(text: str) -> list[str | Shown]:
    """The page as lines of text and commands, in order."""
    lines = text.splitlines()
    found: list[str | Shown] = []
    i = 0
    while i < len(lines):
        if not lines[i].startswith(f"{PROMPT}vinetrack"):
            found.append(lines[i])
            i += 1
            continue
        end = i + 1
        while lines[end - 1].endswith("\\"):
            end += 1
        stop = end
        while stop < len(lines) and (lines[stop].startswith(INDENT) or not lines[stop].strip()):
            if lines[stop].startswith(PROMPT):
                break
            stop += 1
        command = " ".join(line.removeprefix(PROMPT).strip().removesuffix("\\") for line in lines[i:end])
        output = "\n".join(line.removeprefix(INDENT) for line in lines[end:stop]).strip("\n")
        found.append(Shown(tuple(lines[i:end]), tuple(shlex.split(command)[1:]), output))
        i = stop
    return found


def printed(shown: Shown, exits: Container[int] = (0,)) -> str:
    """What the command prints now; it must end with one of these exit codes."""
    done = CliRunner().invoke(app, list(shown.arguments), catch_exceptions=False)
    if done.exit_code not in exits:
        raise AssertionError(done.output)
    return re.sub(r"[ \t]+$", "", done.output, flags=re.MULTILINE).strip("\n")
