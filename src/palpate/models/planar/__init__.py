"""Rigid bodies in the plane on wheels, pivots and links."""

from palpate.models.planar.parameters import PlanarState as PlanarState
from palpate.models.planar.planar import Planar as Planar
from palpate.models.planar.shapes import furniture as furniture
