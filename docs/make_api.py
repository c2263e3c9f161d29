# SPDX-License-Identifier: MIT
"""Describe the public functions and types in Markdown, from their signatures and docstrings."""

from __future__ import annotations

import html
import inspect
import re
from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import Any, NamedTuple

API: Mapping[str, Mapping[str, str]] = {
    "Functions": {
        "densify.open_sequence": "",
        "densify.run": "",
        "densify.run_keys": "",
        "densify.compare": "",
        "densify.estimate_flow": "",
        "densify.make_dataset": "",
        "densify.outlier_probability": "",
    },
    "Results": {
        "densify.load_result": "",
        "densify.outputs.finished_run.LoadedResult": "",
        "densify.outputs.finished_run.LoadedMaps": "",
        "densify.Result": "",
        "densify.Cloud": "displaced select columns to_numpy",
        "densify.DepthMap": "to_points",
        "densify.geometry.types.ObjectTrack": "",
        "densify.geometry.types.CameraView": "",
        "densify.FlowField": "total",
    },
    "Recordings": {
        "densify.LidarSequence": (
            "name frames cameras truth stamp_ns image_stamps_ns image T_world_lidar"
        ),
        "densify.Sweep": "select",
        "densify.Camera": "is_rolling readout_s is_rectified measure focal_px",
    },
    "Training sets": {
        "densify.manifest": "",
        "densify.DepthDataset": "",
        "densify.Recipe": "",
        "densify.Gate": "",
        "densify.dataset.make.Summary": "count num_left mean",
    },
    "Settings and errors": {
        "densify.config.resolve": "",
        "densify.InputError": "",
        "densify.ComputationError": "",
    },
}
"""Heading of the page -> name of a function or type -> names of its members that are public."""

_SECTION = re.compile(r"^(Args|Attributes|Returns|Raises):\n((?:    .*\n|\n)+)", re.MULTILINE)
_TITLES = {"Args": "argument", "Attributes": "attribute", "Raises": "raises"}


class Doc(NamedTuple):
    """A docstring in parts."""

    text: str  # in Markdown, without the sections
    rows: Mapping[str, Mapping[str, str]]  # section -> name -> meaning
    returns: str  # the section "Returns", "" for none


def api() -> str:
    """Return a heading for each group of public names, and below it one for each name."""
    blocks = []
    for title, names in API.items():
        blocks.append(f"## {title}")
        for path, members in names.items():
            blocks += [f"### {path.rpartition('.')[2]}", *_described(path, members.split())]
    return "\n" + "\n\n".join(blocks) + "\n"


def code(text: str) -> str:
    """Return a text as code of a table, where GitHub and mkdocs agree on no other form of a bar."""
    escaped = html.escape(text, quote=False).replace("|", "&#124;")
    return f"<code>{escaped}</code>" if "|" in text else f"`{text}`"


def parse_docstring(docstring: str) -> Doc:
    """Return the parts of a docstring in Google's style, in Markdown."""
    rows: dict[str, dict[str, str]] = {}
    returns = ""
    for section, body in _SECTION.findall(f"{docstring}\n"):
        body = inspect.cleandoc(f"\n{body}")
        if section == "Returns":
            returns = _inline(" ".join(body.split()))
            continue
        items = (item.partition(":") for item in re.split(r"\n(?=\S)", body))
        rows[section] = {name: _inline(" ".join(text.split())) for name, _, text in items}
    paragraphs = re.split(r"\n\n+", _SECTION.sub("", f"{docstring}\n").strip())
    return Doc("\n\n".join(map(_paragraph, paragraphs)), rows, returns)


def _described(path: str, members: list[str]) -> Iterator[str]:
    """Yield the signature, the text, the tables and the members of a function or type."""
    module, _, name = path.rpartition(".")
    thing = getattr(import_module(module), name)
    doc = parse_docstring(inspect.getdoc(thing) or "")
    fields = _fields(thing)
    is_type = inspect.isclass(thing)
    has_fields_or_members = bool(fields) or getattr(thing, "_is_protocol", False)
    if has_fields_or_members or (is_type and issubclass(thing, Exception)):
        yield f"`{path}`"
    else:
        yield f"```python\n{_signature(path, inspect.signature(thing))}\n```"
        if is_type:
            made = parse_docstring(inspect.getdoc(thing.__init__) or "")
            doc = doc._replace(rows={**doc.rows, **made.rows})
    yield doc.text
    rows = dict(doc.rows)
    raises = rows.pop("Raises", {})
    for section, of_section in rows.items():
        yield _table(_TITLES[section], of_section, fields if section == "Attributes" else {})
    if fields and "Attributes" not in rows:
        yield _table(_TITLES["Attributes"], _comments(thing), fields)
    if doc.returns:
        yield f"Returns: {doc.returns}"
    if raises:
        yield _table(_TITLES["Raises"], raises, {})
    if members:
        yield "Members:"
        yield "\n".join(_member(thing, member) for member in members)


def _fields(thing: Any) -> dict[str, str]:
    """Return the type and default of each field of a dataclass or named tuple, in Markdown."""
    is_record = hasattr(thing, "__dataclass_fields__") or hasattr(thing, "_fields")
    if not is_record:
        return {}
    parameters = inspect.signature(thing).parameters.values()
    return {p.name: _typed(p).removeprefix(f"{p.name}: ") for p in parameters}


def _comments(thing: Any) -> dict[str, str]:
    """Return the comment behind each field of a record in its source."""
    found = re.findall(r"^    (\w+): [^#\n]*  # (.*)$", inspect.getsource(thing), re.MULTILINE)
    return {name: _inline(text[0].upper() + text[1:] + ".") for name, text in found}


def _table(title: str, rows: Mapping[str, str], types: Mapping[str, str]) -> str:
    """Return a table of names and meanings, with the types where they are known."""
    lines = [f"| {title} | type | meaning |" if types else f"| {title} | meaning |"]
    lines.append("|---|---|---|" if types else "|---|---|")
    for name, meaning in rows.items():
        cells = [code(name), *([code(types[name])] if types else []), meaning.replace("|", r"\|")]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _member(thing: Any, name: str) -> str:
    """Return a line about a property or method."""
    member = inspect.getattr_static(thing, name)
    function = member.fget if isinstance(member, property) else getattr(thing, name)
    doc = parse_docstring(inspect.getdoc(function) or "")
    signature = inspect.signature(function)
    if isinstance(member, property):
        usage = f"{name}: {_annotation(signature.return_annotation)}"
    else:
        parameters = [_typed(p) for p in signature.parameters.values() if p.name != "self"]
        usage = f"{name}({', '.join(parameters)}) -> {_annotation(signature.return_annotation)}"
    arguments = [f"`{n}`: {text}" for n, text in doc.rows.get("Args", {}).items()]
    return f"- `{usage}`: " + " ".join([" ".join(doc.text.split()), *arguments])


def _signature(path: str, signature: inspect.Signature) -> str:
    """Return a signature, one argument a line if there are several."""
    parameters = list(signature.parameters.values())
    texts = [_typed(parameter) for parameter in parameters]
    keyword_only = [p.kind is inspect.Parameter.KEYWORD_ONLY for p in parameters]
    if any(keyword_only):
        texts.insert(keyword_only.index(True), "*")
    returned = _annotation(signature.return_annotation)
    end = "" if returned == "None" else f" -> {returned}"
    if len(texts) > 1:
        return f"{path}(\n" + "".join(f"    {text},\n" for text in texts) + f"){end}"
    return f"{path}({', '.join(texts)}){end}"


def _typed(parameter: inspect.Parameter) -> str:
    """Return a parameter with its type and default."""
    text = f"{parameter.name}: {_annotation(parameter.annotation)}"
    if parameter.default is inspect.Parameter.empty:
        return text
    default = repr(parameter.default).replace("'", '"')
    return f"{text} = {'…' if default == '<factory>' else default}"


def _annotation(annotation: Any) -> str:
    """Return a type as it is written in the source."""
    text = annotation if isinstance(annotation, str) else getattr(annotation, "__forward_arg__", "")
    return text.replace("'", '"') or str(annotation)


def _paragraph(text: str) -> str:
    """Return a paragraph in Markdown: a block of text as a fence, items with their usage as code.

    Docstrings announce a block of text by two colons.
    """
    if text.startswith("    "):
        return f"```text\n{inspect.cleandoc(chr(10) + text)}\n```"
    if text.startswith("- "):
        items = (item.partition(": ") for item in re.split(r"\n(?=- )", text))
        return "\n".join(f"- `{u[2:]}`: {_inline(' '.join(t.split()))}" for u, _, t in items)
    return _inline(re.sub(r"::$", ":", text))


def _inline(text: str) -> str:
    """Return a text with the code of docstrings as code of Markdown."""
    return text.strip().replace("``", "`")
