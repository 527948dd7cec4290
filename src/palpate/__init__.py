"""Find out an object's physics by handling it, act through what was found, and stay safe.

Recordings become differentiable models (`palpate.identification`), models become controllers
(`palpate.learning`), and controllers are tried in worlds that the models cannot see into
(`palpate.worlds`). The command line does the same: `palpate --help`.
"""

from importlib.metadata import PackageNotFoundError, version

from palpate.numerics import devices

try:
    __version__ = version("palpate")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+source"

devices.prepare()
