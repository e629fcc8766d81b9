"""Sphinx configuration: Markdown by MyST, furo, autodoc; builds without a network."""

import inspect
import pkgutil
import re
from importlib import import_module
from pathlib import Path

import closerange
from closerange import flags
from closerange.version import __version__

project = "closerange"
author = "the closerange authors"
copyright = "the closerange authors; BSD-3-Clause"  # noqa: A001  # Sphinx's own name
release = version = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"closerange {release}"
html_show_sourcelink = False
html_theme_options = {"navigation_with_keys": True}

myst_enable_extensions = ["substitution", "deflist"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 80
napoleon_google_docstring = False
napoleon_use_ivar = True  # dataclass fields are described once, in Attributes
napoleon_use_rtype = False
# annotations name types without their modules; two rooms may have a type of one name
suppress_warnings = ["ref.python"]

ROOMS = {
    "foundations": ("errors", "flags", "files"),
    "geometry": ("geometry",),
    "images": ("images",),
    "features": ("features",),
    "rig": ("rig",),
    "matching": ("matching",),
    "position": ("position",),
    "parts": ("parts",),
    "verification": ("verification",),
    "delivery": ("delivery",),
    "workflows": ("settings", "workflows"),
}


def flags_table() -> str:
    """Return the registry of flags with the comments beside its bits."""
    source = inspect.getsource(flags.Flag)
    rows = re.findall(r"^    (\w+) = 1 << (\d+)  # (.+)$", source, re.MULTILINE)
    if len(rows) != len(list(flags.Flag)):
        raise RuntimeError("a flag has no comment in closerange.flags")
    lines = ["| flag | bit | meaning |", "| --- | ---: | --- |"]
    return "\n".join(lines + [f"| `{name}` | {bit} | {text} |" for name, bit, text in rows])


def public_modules(name: str) -> list[str]:
    """Return a room and its modules; none if the room does not exist."""
    folder = Path(closerange.__file__).parent
    if not (folder / name).is_dir():
        return [f"closerange.{name}"] if (folder / f"{name}.py").is_file() else []
    room = import_module(f"closerange.{name}")
    modules = sorted(m.name for m in pkgutil.iter_modules(room.__path__) if m.name[0] != "_")
    return [f"closerange.{name}.{module}" for module in modules]


def api_text(names: tuple[str, ...]) -> str:
    """Return autodoc directives for all modules of some rooms."""
    blocks = []
    for module in (m for name in names for m in public_modules(name)):
        title = module.removeprefix("closerange.")
        blocks += [title, "-" * len(title), "", f".. automodule:: {module}", "   :members:", ""]
    if not blocks:
        return "This room does not exist in this version."
    return "\n".join(["```{eval-rst}", *blocks, "```"])


def public_names() -> str:
    """Return autodoc directives for the names that `closerange` exports."""
    names = sorted(getattr(closerange, "__all__", ()))
    if not names:
        return "This version exports no names at the top."
    blocks = ["```{eval-rst}"]
    for name in names:
        value = getattr(closerange, name)
        if inspect.isclass(value):
            blocks += [f".. autoclass:: closerange.{name}", "   :members:", "   :no-index:", ""]
        elif callable(value):
            blocks += [f".. autofunction:: closerange.{name}", "   :no-index:", ""]
    return "\n".join([*blocks, "```"])


def escape_bars(_app, _what, _name, _obj, _options, lines):
    """Let |x| in docstrings be a magnitude and not a substitution of reStructuredText."""
    for row, line in enumerate(lines):
        parts = line.split("``")
        parts[::2] = [part.replace("|", "\\|") for part in parts[::2]]
        lines[row] = "``".join(parts)


def setup(app):
    """Connect the docstring filter."""
    app.connect("autodoc-process-docstring", escape_bars, priority=100)


myst_substitutions = {
    "flags_table": flags_table(),
    "public_names": public_names(),
    **{f"api_{room}": api_text(names) for room, names in ROOMS.items()},
}
