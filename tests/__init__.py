"""The tests mirror the rooms of the package; what several rooms' tests share lies here."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
