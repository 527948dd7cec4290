"""Sphinx configuration: Markdown through MyST, examples executed while building."""

from importlib.metadata import version as installed_version

project = "palpate"
author = "The palpate developers"
version = release = installed_version("palpate")

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["colon_fence", "dollarmath"]
nb_execution_raise_on_error = True
exclude_patterns = ["_build"]

html_theme = "furo"
html_title = f"palpate {release}"
