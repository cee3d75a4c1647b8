"""Complex numbers that are known within discs: arithmetic whose results hold for every number.

A disc is a centre and a radius. Each operation gives a disc that contains every result for operands
within their discs; rounding is not counted. An operation that may divide by 0 gives an infinite
radius.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Disc(NamedTuple):
    """All complex numbers within `radius` (...,) of `centre` (...,)."""

    centre: np.ndarray
    radius: np.ndarray

    def plus(self, other: Disc) -> Disc:
        return Disc(self.centre + other.centre, self.radius + other.radius)

    def minus(self, other: Disc) -> Disc:
        return Disc(self.centre - other.centre, self.radius + other.radius)

    def times(self, other: Disc) -> Disc:
        a, b = np.abs(self.centre), np.abs(other.centre)
        with np.errstate(invalid="ignore"):
            radius = a * other.radius + b * self.radius + self.radius * other.radius
        return Disc(self.centre * other.centre, _no_nan(radius))

    def inverse(self) -> Disc:
        """1 / x; the image of a disc without 0 is a disc, here about the inverse of its centre."""
        a = np.abs(self.centre)
        away = a > self.radius
        safe = np.where(away, self.centre, 1.0)
        gap = np.where(away, a * (a - self.radius), 1.0)
        return Disc(1 / safe, np.where(away, self.radius / gap, np.inf))

    def exponential(self) -> Disc:
        """exp(x); |exp(c + d) - exp(c)| <= |exp(c)| (exp(|d|) - 1)"""
        centre = np.exp(self.centre)
        with np.errstate(over="ignore"):
            return Disc(centre, np.abs(centre) * np.expm1(self.radius))

    @property
    def largest(self) -> np.ndarray:
        """(...,) the largest magnitude in the disc."""
        return np.abs(self.centre) + self.radius


def exactly(value) -> Disc:
    """Numbers that are known."""
    value = np.asarray(value, complex)
    return Disc(value, np.zeros(value.shape))


def _no_nan(radius) -> np.ndarray:
    return np.where(np.isnan(radius), np.inf, radius)
