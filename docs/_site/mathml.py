"""A Sphinx maths renderer: TeX to MathML at build time, with docutils' own converter."""

from __future__ import annotations

import html
import re
from typing import Any
from xml.etree import ElementTree

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

SPACE = "http://www.w3.org/1998/Math/MathML"
ACCENTS = ("˙", "¨", "ˆ")


def mended(element: ElementTree.Element) -> None:
    """Put right in place what the converter gets wrong: an accented letter's subscript, the space around bars."""
    for child in element:
        mended(child)
    name = element.tag.rpartition("}")[2]
    if name == "munderover" and element[2].text in ACCENTS:  # \dot x_b: not below the letter, but beside it
        letter, below, accent = element
        over = ElementTree.Element(f"{{{SPACE}}}mover", {"accent": "true"})
        over.extend([letter, accent])
        element.tag = f"{{{SPACE}}}msub"
        element[:] = [over, below]
    if name == "mo" and element.text == "|":
        element.attrib.update(lspace="0", rspace="0")


def markup(tex: str, block: bool) -> str:
    """MathML of `tex`; raises docutils' MathError where it is not understood, which fails the build."""
    ElementTree.register_namespace("", SPACE)
    text = tex2mathml(" ".join(tex.split()), as_block=block)
    tree = ElementTree.fromstring(re.sub(r"&(?!lt;|gt;|amp;|#)\w+;", lambda entity: html.unescape(entity[0]), text))
    mended(tree)
    for element in tree.iter():
        element.tail = None
        if len(element):
            element.text = None
    return ElementTree.tostring(tree, encoding="unicode")


def inline(writer: Any, node: nodes.math) -> None:
    """Write a formula within a sentence."""
    writer.body.append(markup(node.astext(), False))
    raise nodes.SkipNode


def display(writer: Any, node: nodes.math_block) -> None:
    """Write a formula that stands alone."""
    writer.body.append(f'<div class="math">{markup(node.astext(), True)}</div>')
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, bool]:
    """Register with Sphinx."""
    app.add_html_math_renderer("mathml", (inline, None), (display, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
