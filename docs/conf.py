from importlib.metadata import version as _version

project = "pyklip_diffrender"
author = "pyklip_diffrender developers"
copyright = "2025, pyklip_diffrender developers"
release = version = _version("pyklip-diffrender")

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
]
exclude_patterns = ["_build", "results"]
html_theme = "furo"

autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_typehints = "none"
numpydoc_show_class_members = False
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
