"""How the documentation is built: `make docs`; its examples are executed."""

import importlib
import inspect
import re
from typing import Any

from docutils.nodes import SkipNode
from latex2mathml.converter import convert

project = "sideslip"
author = "The sideslip authors"
release = importlib.import_module("sideslip").__version__
make_estimator = importlib.import_module("sideslip.estimators").make_estimator

extensions = ["myst_nb", "sphinx.ext.autodoc"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "sideslip"
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_css_files = ["site.css"]
templates_path: list[str] = []

myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 600
nb_merge_streams = True

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True


def typeset(
    _app: Any, _what: str, _name: str, _object: Any, _options: Any, lines: list[str]
) -> None:
    """Our docstrings are plain text: the first paragraph is prose, the rest stays as it is written.

    Examples are doctest blocks.
    """
    blocks = re.split(r"\n[ \t]*\n", inspect.cleandoc("\n".join(lines)))
    made: list[str] = []
    for i, block in enumerate(filter(str.strip, blocks)):
        if block.lstrip().startswith(">>>"):
            made += [*inspect.cleandoc(block).splitlines(), ""]
        elif i == 0:
            made += [re.sub(r"([*_|\\])(?=\S)", r"\\\1", _literals(block)), ""]
        else:
            made += [".. code-block:: text", "", *("   " + line for line in block.splitlines()), ""]
    lines[:] = made


def _literals(text: str) -> str:
    """Names in single backticks as literals; the rest joined to a paragraph."""
    return re.sub(r"(?<!`)`([^`]+)`(?!`)", r"``\1``", " ".join(text.split()))


def inline(self: Any, node: Any) -> None:
    """A formula as MathML, which browsers draw without scripts from elsewhere."""
    self.body.append(convert(node.astext()))
    raise SkipNode


def block(self: Any, node: Any) -> None:
    """A formula on a line of its own."""
    self.body.append(f'<div class="formula">{convert(node.astext(), display="block")}</div>')
    raise SkipNode


def setup(app: Any) -> None:
    """Called by Sphinx."""
    # autodoc reads defaults from the text of a signature; `FilterOptions` lists a filter's options
    vars(make_estimator).pop("__signature__", None)
    app.add_html_math_renderer("mathml", (inline, None), (block, None))
    app.connect("autodoc-process-docstring", typeset)
