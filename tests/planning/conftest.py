"""Vines grown by scipy stand with the tests of the model."""

from __future__ import annotations
