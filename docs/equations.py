# SPDX-License-Identifier: MIT
"""Hook of mkdocs: equations become MathML, which browsers draw without a script or a network."""

import html
import re

from latex2mathml.converter import convert


def on_page_content(content: str, **_: object) -> str:
    """Return the page with its equations as MathML."""
    for ends, display in ((r"\\\((.*?)\\\)", "inline"), (r"\\\[(.*?)\\\]", "block")):
        pattern = rf'(<(?:span|div) class="arithmatex">){ends}(</(?:span|div)>)'

        def drawn(found: re.Match[str], display: str = display) -> str:
            equation = html.unescape(found[2]).strip()
            return found[1] + convert(equation, display=display) + found[3]

        content = re.sub(pattern, drawn, content, flags=re.DOTALL)
    return content
