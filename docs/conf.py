"""Configuration of the documentation. It builds without a network."""

import csv
import hashlib
import inspect
import os
import re
import sys
from pathlib import Path

import click
import latex2mathml.converter
from docutils.nodes import SkipNode, Text, entry, inline
from numpydoc.xref import DEFAULT_LINKS

import pyklip_diffrender
from pyklip_diffrender import cli, errors
from pyklip_diffrender.parameters import LEVELS, OPTICAL_PARAMETERS

sys.path.insert(0, str(Path(__file__).parent))
import generate

project = "pyklip_diffrender"
author = "pyklip_diffrender developers"
copyright = "2025, pyklip_diffrender developers"
release = version = pyklip_diffrender.__version__

extensions = [
    "myst_nb",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.intersphinx",
    "sphinx.ext.viewcode",
]
# `_shared` has texts that several pages include.
exclude_patterns = ["_build", "_shared", "results"]
templates_path = ["_templates"]
html_static_path = ["_static"]
html_css_files = ["tables_and_figures.css"]
html_theme = "furo"
html_title = f"pyklip_diffrender {release}"

# Docstrings name things in single backticks; what the documentation has becomes a link.
default_role = "py:obj"
autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_typehints = "none"
numpydoc_show_class_members = False
numpydoc_xref_param_type = True
numpydoc_xref_aliases = {
    name: f"pyklip_diffrender.errors.{name}"
    for name, each in vars(errors).items()
    if inspect.isclass(each) and issubclass(each, Exception)
}
numpydoc_xref_aliases["OPDMap"] = "pyklip_diffrender.wavefront.OPDMap"

# References have to exist, but for words that stand in single backticks or in the type of a
# parameter, other projects, attributes of dataclasses, and helpers that have no page.
nitpicky = True
nitpick_ignore_regex = [
    ("py:obj", r"[^.]*"),
    ("py:obj", r"(poppy|pyklip|spaceKLIP|stpsf|torch|webbpsf)\..*"),
    ("py:obj", r"(FitSettings|RoundMask|calibration|contrast|spectrum)\..*"),
    ("py:obj", r"pyklip_diffrender\.(linear|pyklip_backend\.subtract|scene\.integrations)\..*"),
]
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3

# Tutorials are run by the build, and an error in one of them ends it. Outputs are kept for the next
# build, unless the package has changed in between.
_package = Path(pyklip_diffrender.__file__).parent
_code = b"".join(path.read_bytes() for path in sorted(_package.rglob("*.py")))
_cache = Path(__file__).parent / "_build" / "tutorials" / hashlib.sha256(_code).hexdigest()[:16]
# Warnings of the machine that builds, such as a missing widget for progress bars.
nb_output_stderr = "remove"
nb_execution_mode = "cache"
nb_execution_cache_path = str(_cache)
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_execution_show_tb = True
# Cells that are not run (nb_execution_mode=off) do not say their language.
suppress_warnings = ["myst-nb.lexer"]
# A cell prints in several pieces, and they are one output.
nb_merge_streams = True
# This one needs frames of the telescope. Without them the page has the outputs that its file has.
if not os.environ.get("DIFFRENDER_DOCS_DATA"):
    nb_execution_excludepatterns = ["tutorials/hip65426.ipynb"]

# Links to other projects need their inventories, so they are made only where that is asked for:
# an inventory that cannot be fetched is a warning, and warnings are errors in the build.
intersphinx_mapping = {}
if not (os.environ.get("READTHEDOCS") or os.environ.get("DOCS_INTERSPHINX")):
    numpydoc_xref_aliases |= {name: name for name in DEFAULT_LINKS}
else:
    intersphinx_mapping = {
        "python": ("https://docs.python.org/3", None),
        "numpy": ("https://numpy.org/doc/stable", None),
        "astropy": ("https://docs.astropy.org/en/stable", None),
        "torch": ("https://docs.pytorch.org/docs/stable", None),
        "pyklip": ("https://pyklip.readthedocs.io/en/latest", None),
    }

# Equations become MathML, which browsers render by themselves: no script, no download.
html_math_renderer = "mathml"


def _inline_math(self, node):
    self.body.append(latex2mathml.converter.convert(node.astext()))
    raise SkipNode


def _display_math(self, node):
    self.body.append(latex2mathml.converter.convert(node.astext(), display="block"))
    raise SkipNode


def _write_tables(app):
    """Write what the pages take from the code: the free parameters and the commands' options."""
    folder = Path(app.srcdir) / "generated"
    folder.mkdir(exist_ok=True)
    generate.write_tables(folder)
    with open(folder / "parameters.csv", "w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file)
        for each in (*OPTICAL_PARAMETERS, *LEVELS):
            size = f"{each.name} ({each.size})" if each.size > 1 else each.name
            rows.writerow(
                [size, each.unit, f"{each.start:g}", f"{each.lower:g} to {each.upper:g}",
                 f"{each.prior:g}", each.description]
            )  # fmt: skip
    program = cli.application
    group = click.Context(program, info_name="pyklip-diffrender", terminal_width=88)
    pages = {"pyklip-diffrender": program.get_help(group)}
    for name, command in program.commands.items():
        pages[name] = command.get_help(click.Context(command, group, name, terminal_width=88))
    for name, text in pages.items():
        (folder / f"{name}.txt").write_text(text + "\n", encoding="utf-8")


_NUMBER = re.compile(r"(\(?[+-]?(?<![\w.])\d[\d.]*(?:e-?\d+)?(?: \+- [\d.e-]+)?(?: %)?\)?)(?!\w)")
"""Numbers in tables, with error, percent sign and brackets, which a line must not break."""


def _mark_short_cells(app, doctree):
    """Tell the style sheet which cells, options and numbers of tables are not broken."""
    for cell in doctree.findall(entry):
        content = cell.astext()
        if len(content) < 10 or (content.startswith("--") and " " not in content):
            cell["classes"].append("short")
            continue
        for text in list(cell.findall(Text)):
            pieces = _NUMBER.split(text)
            if len(pieces) > 1:
                whole = [
                    inline("", piece, classes=["number"]) if k % 2 else Text(piece)
                    for k, piece in enumerate(pieces)
                ]
                text.parent.replace(text, whole)


def _named_alone(app, env, node, contnode):
    """Link a name without its package to the only page that documents it."""
    domain, target = env.get_domain("py"), node.get("reftarget", "")
    found = [
        name
        for name, each in domain.objects.items()
        if name.endswith(f".{target}")
        and not each.aliased
        and ("." in target or each.objtype in ("class", "function"))
    ]
    if node.get("refdomain") != "py" or len(found) != 1:
        return None
    return domain.resolve_xref(
        env, node["refdoc"], app.builder, node["reftype"], found[0], node, contnode
    )


def setup(app):
    app.connect("missing-reference", _named_alone)
    app.add_html_math_renderer(
        "mathml", inline_renderers=(_inline_math, None), block_renderers=(_display_math, None)
    )
    app.connect("builder-inited", _write_tables)
    app.connect("doctree-read", _mark_short_cells)
