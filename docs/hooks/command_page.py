"""The reference of commands and of exit statuses, from the parser of the command line."""

from __future__ import annotations

import argparse
import inspect
import re
import textwrap
from collections.abc import Iterator

from markup import block, code, prose, table

import fauio

_WIDTH = 100
_INTRODUCTION = """# Commands

What `--help` of each command says, written from the same parser. Results go to standard output, with `--json` as JSON;
errors are one line on standard error that begins with `fauio:`. [Exit status](exit-status.md) says how a command ended.
"""


def commands_page() -> str:
    """Return the page of all commands."""
    parser = fauio.build_parser()
    commands = list(_commands(parser))
    summary = ((f"[`{sub.prog}`](#{sub.prog.replace(' ', '-')})", prose(help_text)) for sub, help_text in commands)
    parts = [_INTRODUCTION, table(("command", "what it does"), summary), f"\n{block('fauio --version', 'bash')}"]
    for sub, _ in commands:
        parts += _sections(sub, "##")
    return "\n".join(parts) + "\n"


def exit_status_page() -> str:
    """Return the page of exit statuses: those of all commands, and what single commands say of theirs."""
    doc = " ".join(inspect.cleandoc(fauio.main.__doc__ or "").split())
    listed = re.findall(r"(\d+) ((?:\([^)]*\)|[^,(])+)(?:, |\.)", doc.partition("Exit status: ")[2])
    parts = [
        "# Exit status",
        "",
        table(("status", "meaning"), ((f"`{status}`", prose(meaning)) for status, meaning in listed)),
        "",
        "A single command may say more:",
        "",
    ]
    for sub, _ in _commands(fauio.build_parser()):
        said = re.search(r"Exit status: (.*)", " ".join((sub.description or "").split()))
        if said:
            parts.append(f"- [`{sub.prog}`](commands.md#{sub.prog.replace(' ', '-')}): {prose(said[1])}")
    return "\n".join(parts) + "\n"


def _commands(parser: argparse.ArgumentParser) -> Iterator[tuple[argparse.ArgumentParser, str]]:
    """Yield the parser and the one-line help of each command of a parser."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            help_of = {choice.dest: choice.help or "" for choice in action._choices_actions}
            for name, sub in action.choices.items():
                yield sub, help_of[name]


def _sections(parser: argparse.ArgumentParser, level: str) -> Iterator[str]:
    yield f"\n{level} {parser.prog}\n"
    yield _description(parser.description or "")
    yield f"\n{block(_usage(parser))}\n"
    for group in parser._action_groups:
        shown = [action for action in group._group_actions if not _is_hidden(action)]
        if shown:
            head = "argument" if group.title == "positional arguments" else group.title or "option"
            yield table(
                (head.removesuffix("s"), "meaning"), ([_invocation(one), _meaning(parser, one)] for one in shown)
            )
            yield ""
    if parser.epilog:
        yield block(re.sub(r"^examples?:\s*", "", parser.epilog), "bash")
    for sub, _ in _commands(parser):
        yield from _sections(sub, f"{level}#")


def _is_hidden(action: argparse.Action) -> bool:
    is_inner = isinstance(action, argparse._HelpAction | argparse._SubParsersAction)
    return is_inner or action.help == argparse.SUPPRESS


def _description(text: str) -> str:
    """Return a description: paragraphs as prose, what is laid out in columns as a block under its first line."""
    parts = []
    for paragraph in re.split(r"\n\s*\n", text.strip()):
        first, _, rest = paragraph.partition("\n")
        if rest.startswith(" "):
            parts.append(f"{first.strip().capitalize()}:\n\n{block(textwrap.dedent(rest))}")
        else:
            parts.append(prose(paragraph))
    return "\n\n".join(parts)


def _usage(parser: argparse.ArgumentParser) -> str:
    formatter = argparse.HelpFormatter(parser.prog, width=_WIDTH)
    formatter.add_usage(parser.usage, parser._actions, parser._mutually_exclusive_groups)
    first, *rest = formatter.format_help().strip().removeprefix("usage: ").split("\n")
    return "\n".join([first, *(line.removeprefix(" " * len("usage: ")) for line in rest)])


def _invocation(action: argparse.Action) -> str:
    if not action.option_strings:
        return code(str(action.metavar or action.dest))
    default = action.dest.upper()
    formatter = argparse.HelpFormatter("")
    metavar = "" if action.nargs == 0 else f" {formatter._format_args(action, default)}"
    if action.choices is not None and action.metavar is None:
        metavar = f" [{default}]" if action.nargs == "?" else f" {default}"
    return code(f"{', '.join(action.option_strings)}{metavar}")


def _meaning(parser: argparse.ArgumentParser, action: argparse.Action) -> str:
    text = prose(parser._get_formatter()._expand_help(action)) if action.help else ""
    if action.choices is not None:
        text += f"{'. ' if text else ''}One of {', '.join(code(str(choice)) for choice in action.choices)}"
    return f"{text}; required" if action.option_strings and action.required else text
