"""`palpate identify`."""

from palpate.commands.identify.command import run as run
