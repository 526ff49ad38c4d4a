"""What is true in a virtual experiment and hidden from the analysis: physics, scatter, noise, faults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from vinetrack.dynamics.model import Model, Value, make_model

BASE = ("pressure_drive", "gravity", "eversion_damping", "yield_pressure")


@dataclass(frozen=True, kw_only=True)
class Nature:
    """The truth behind a campaign.

    `effects` and `values` are the physics. Scatter is a standard deviation from trial to trial, relative to B and to P;
    `yield_error_kPa` that of the yield pressure stated for each vine. `release_frames` bounds the rest frames before
    release, whose instant is uniform between two frames; `origin_m` bounds the unknown zero of position. Noise is
    AR(1) with standard deviation `noise_m` and lag-one correlation `noise_correlation`. `dropped` and `repeated` are
    probabilities per moving frame. `trace_sigma_kPa` is the noise of a recorded pressure (None: none is recorded).
    """

    effects: tuple[str, ...] = BASE
    values: Mapping[str, Value] = field(default_factory=dict)
    damping_scatter: float = 0.03
    pressure_scatter: float = 0.01
    yield_error_kPa: float = 0.0
    noise_m: float = 1e-4
    noise_correlation: float = 0.0
    release_frames: tuple[int, int] = (15, 40)
    frames_after_end: int = 4
    longest_frames: int = 12_000
    origin_m: tuple[float, float] = (-0.05, 0.05)
    dropped: float = 0.0
    repeated: float = 0.0
    trace_sigma_kPa: float | None = None
    stated_sigma: bool = False
    seed: int = 0

    def model(self) -> Model:
        """The true model with its true values."""
        return make_model(self.effects).with_values(self.values)


def read_nature(path: Path) -> Nature:
    """Read a nature from YAML; its keys are the fields of `Nature`, and `filming`, which is not read here."""
    content: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    content.pop("filming", None)
    for key in ("effects", "release_frames", "origin_m"):
        if key in content:
            content[key] = tuple(content[key])
    return Nature(**content)
