"""The page of the command line, from the annotations of the commands: help, arguments, options, defaults, choices."""

import enum
import inspect
import re
import types
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from typer.models import ArgumentInfo, OptionInfo, ParamMeta
from typer.utils import get_params_from_function

from khop_env.cli import COMMANDS

NAMES = {int: "INTEGER", float: "NUMBER", str: "TEXT", Path: "PATH"}
_VALUE = r"[\w./,-]+[:=@][^\s;()]*\w"  # lossy:loss=0.3,burst=5
CODE = re.compile(
    r"(?<=[:(] )khop [a-z]+[^.;()]*(?:\.\w[^.;()]*)*(?=[.;)])"  # a whole command, at a sentence's end
    r"|khop [a-z]+"
    rf"|--[a-z][a-z-]*(?: {_VALUE})?"
    r"|(?<![\w./])[\w./]*\.(?:toml|py|json|mp4|gif|csv)(?::\w+)?\b"
    rf"|(?<!\w){_VALUE}"
    r"|\bruns/[\w/-]*"
    r"|\b(?:\w+[.,])*\w*_\w+(?:[.,]\w+)*"
)
HEAD = """# Command line

`khop` is installed with the library; in a clone it is `.venv/bin/khop`. `khop COMMAND --help` shows what is below.
Wherever a name goes, a Python object may stand: `my_file.py:my_scenario` or `my_module:MyTask`.

Tables, and one JSON object with `--json`, go to stdout; progress and messages go to stderr. Exit status:

| | |
|---|---|
| 0 | done |
| 1 | a check or a run found the observers' guarantee or the environments' contract broken |
| 2 | a mistake of the user's, or something failed on the way; the message says what to do |
| 130 | after Ctrl-C, with the results up to then |

"""


def page() -> str:
    """The whole page, in Markdown."""
    rows = "".join(
        f"| [`{name}`](#khop-{name}) | {_marked(_paragraphs(command)[0])} |\n" for name, command in COMMANDS.items()
    )
    sections = "\n".join(_section(name, command) for name, command in COMMANDS.items())
    return f"{HEAD}| command | |\n|---|---|\n{rows}\n{sections}"


def _paragraphs(command: Callable[..., None]) -> list[str]:
    return [" ".join(part.split()) for part in (inspect.getdoc(command) or "").split("\n\n")]


def _section(name: str, command: Callable[..., None]) -> str:
    parameters = get_params_from_function(command).values()
    arguments = [each for each in parameters if isinstance(each.default, ArgumentInfo)]
    options = [each for each in parameters if isinstance(each.default, OptionInfo)]
    usage = "".join(f" {_argument(each)}" for each in arguments)
    text = "\n\n".join(map(_marked, _paragraphs(command)))
    entries = [f"**`{_argument(each)}`**\n: {_marked(each.default.help)}\n" for each in arguments]
    entries += map(_option, options)
    return f"## khop {name}\n\n```text\nkhop {name} [OPTIONS]{usage}\n```\n\n{text}\n\n" + "\n".join(entries)


def _argument(parameter: ParamMeta) -> str:
    return parameter.default.metavar or parameter.name.upper()


def _option(parameter: ParamMeta) -> str:
    info = parameter.default
    name = ", ".join(info.param_decls or [f"--{parameter.name.replace('_', '-')}"])
    plain, several = _plain(parameter.annotation)
    choices = [str(choice.value) for choice in plain] if issubclass(plain, enum.Enum) else []
    value = "" if plain is bool else info.metavar or "|".join(choices) or NAMES[plain]
    sentences = [_marked(info.help)]
    if not info.help.endswith("."):
        sentences[0] += "."
    if info.min is not None:
        sentences.append(f"At least {info.min:g}.")
    if info.max is not None:
        sentences.append(f"At most {info.max:g}.")
    if several and "repeatable" not in info.help:
        sentences.append("Repeatable.")
    if info.default is not None and info.default is not False and info.default != "":
        default = info.default.value if isinstance(info.default, enum.Enum) else info.default
        sentences.append(f"Default: `{default}`.")
    return f"**`{name}{' ' + value if value else ''}`**\n: {' '.join(sentences)}\n"


def _plain(kind: Any) -> tuple[type, bool]:
    """The type of one value, and whether the option takes a list of them."""
    members = [each for each in typing.get_args(kind) if each is not type(None)]
    if isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union:
        (kind,) = members
    if typing.get_origin(kind) is list:
        return typing.get_args(kind)[0], True
    return kind, False


def _marked(text: str) -> str:
    """Help with options, commands, files and values as code, and everything else literal."""

    def parts() -> Iterator[str]:
        at = 0
        for found in CODE.finditer(text):
            yield re.sub(r"([\\*_<>\[\]|`$])", r"\\\1", text[at : found.start()])
            yield f"`{found[0]}`"
            at = found.end()
        yield re.sub(r"([\\*_<>\[\]|`$])", r"\\\1", text[at:])

    return "".join(parts())
