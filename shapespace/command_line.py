"""What the programs share: help, ``--version``, completion, refused arguments, missing packages and errors in words."""

from __future__ import annotations

import os
import shlex
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from importlib import import_module
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

import click
from click.shell_completion import shell_complete

from shapespace import __version__

#: Exit codes: a fault of the input or of the machine, a command line that can't be carried out, and a defect of the
#: program (EX_SOFTWARE).
FAILURE, USAGE, DEFECT = 1, 2, 70
_SETTINGS = {"help_option_names": ["-h", "--help"]}


class _Formatter(click.HelpFormatter):
    def write_usage(self, prog: str, args: str = "", prefix: str | None = None) -> None:
        super().write_usage(prog, args, prefix or "usage: ")


class _Context(click.Context):
    formatter_class = _Formatter


def _show_version(context: click.Context, _: click.Parameter, given: bool) -> None:
    if given and not context.resilient_parsing:
        click.echo(f"shapespace {__version__}")
        context.exit()


def _version() -> click.Option:
    return click.Option(
        ["--version"], is_flag=True, is_eager=True, expose_value=False, callback=_show_version,
        help="Show the version and exit.",
    )  # fmt: skip


class FileOrFolder(click.Path):
    """Path of the command line, which must not be empty, as after a misspelt variable of the shell.

    Args:
        standard: whether ``-`` may be standard input or output.
    """

    def __init__(self, *, standard: bool = True) -> None:
        super().__init__(path_type=Path, readable=False)  # reading it says more
        self._standard = standard

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path; fail if it is empty, or standard output where that can't be."""
        if value == "":
            self.fail("it is empty; name a file or folder, . for this one", param, ctx)
        if value == "-" and not self._standard:
            self.fail("the results can't go to standard output; name a file or folder", param, ctx)
        return super().convert(value, param, ctx)


class Several(click.Option):
    """Option with one or more values, as in ``--accept FILE FILE``."""

    def __init__(self, names: Sequence[str], **options: Any) -> None:
        super().__init__(names, multiple=True, **options)


class Subcommand(click.Command):
    """One command of a program, with ``--help``, ``--version`` and examples.

    Args:
        name: name of the command.
        work: function that does the work with the parameters, and returns an exit code; or its place MODULE:NAME, which
            is imported when the command runs.
        needs: modules that the command needs, beside the modules of `shapespace` itself.
        extra: extra of the distribution that installs them.
        late_params: place MODULE:NAME of further parameters, which need these packages.
        examples: arguments after the name of the command.
        advice: ends the message about an argument that is refused.
        options: of click.
    """

    context_class = _Context

    def __init__(
        self,
        name: str,
        work: Callable[..., Any] | str,
        *,
        needs: Sequence[str] = (),
        extra: str = "",
        late_params: str = "",
        examples: Sequence[str] = (),
        advice: str = "",
        params: Sequence[click.Parameter] = (),
        context_settings: Mapping[str, Any] = MappingProxyType({}),
        **options: Any,
    ) -> None:
        super().__init__(
            name,
            callback=_imported_late(work) if isinstance(work, str) else work,
            params=[*params, _version()],
            context_settings={**_SETTINGS, **context_settings},
            **options,
        )
        self._missing = partial(missing_packages, needs, extra)
        self._late, self._examples, self.advice = late_params, examples, advice

    @cached_property
    def _further(self) -> list[click.Parameter]:
        return [*_imported(self._late)] if self._late and not self._missing() else []

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """Return all parameters."""
        return [*self._further, *super().get_params(ctx)]

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the arguments, or say which packages the command lacks. An option may have several values."""
        if not ({"-h", "--help", "--version"} & {*args} or ctx.resilient_parsing) and (sentence := self._missing()):
            ctx.exit(fail(sentence, USAGE))
        options = [each for each in self.get_params(ctx) if isinstance(each, click.Option)]
        names = {name for option in options for name in option.opts}
        valued = {name for option in options if not option.is_flag for name in option.opts}
        for name, value in pairwise(args):
            if name in valued and value in names:
                ctx.fail(f"Option {name!r} requires an argument.")
        several = {name for option in options if isinstance(option, Several) for name in option.opts}
        try:
            return super().parse_args(ctx, [*_one_value_each(args, several)])
        except click.UsageError as error:
            error.ctx = error.ctx or ctx  # some errors of the parser have none
            raise

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the examples, and which packages are missing."""
        super().format_epilog(ctx, formatter)
        if self._examples:
            with formatter.section("Examples"):
                for example in self._examples:
                    formatter.write(f"{'':{formatter.current_indent}}{ctx.command_path} {example}".rstrip() + "\n")
        if sentence := self._missing():
            formatter.write_paragraph()
            formatter.write_text(f"The command {sentence}")


class Program(click.Group):
    """A program with several commands, in the order in which they are given."""

    context_class = _Context

    def __init__(self, commands: Sequence[click.Command], **options: Any) -> None:
        named = {str(command.name): command for command in commands}
        super().__init__(
            None, named, params=[_version()], context_settings=_SETTINGS, subcommand_metavar="COMMAND …", **options
        )

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the commands in their order."""
        return [*self.commands]


def call(program: str, command: click.Command, arguments: Sequence[str] | None = None) -> int:
    """Carry out a command line and return the exit code of the work.

    Args:
        program: name of the program, for messages.
        command: the command, or the group of commands.
        arguments: of the command line; by default those that the program was called with.

    Raises:
        SystemExit: help, the version or a completion was asked for (0), an argument is refused (2), or Ctrl-C came
            before the work began (130).
    """
    variable = f"_{program.upper()}_COMPLETE".replace("-", "_")
    if instruction := os.environ.get(variable):
        raise SystemExit(shell_complete(command, {}, program, variable, instruction))
    try:
        with command.make_context(program, [*(sys.argv[1:] if arguments is None else arguments)]) as context:
            return command.invoke(context) or 0
    except click.exceptions.Exit as end:
        raise SystemExit(end.exit_code) from None
    except click.UsageError as error:
        print(_refusal(error), file=sys.stderr)
        raise SystemExit(USAGE) from None
    except KeyboardInterrupt:  # while modules were imported
        print(f"\n{program}: stopped", file=sys.stderr)
        raise SystemExit(128 + signal.SIGINT) from None


def carry_out(
    work: Callable[[], Any],
    expected: tuple[type[Exception], ...],
    *,
    stopped: str = "stopped",
    advice: str = "",
    folder: Callable[[], Path | None] = lambda: None,
) -> int:
    """Do the work of a command and return its exit code. Every error ends with a message, not with a traceback.

    Args:
        work: returns an exit code, or None for 0.
        expected: errors whose message is a sentence for the user.
        stopped: sentence after SIGINT or SIGTERM.
        advice: ends the message about a defect of the program.
        folder: returns a folder for the traceback of a defect, instead of a temporary one.
    """
    from shapespace.files.limits import in_words

    received = [signal.SIGINT]

    def terminate(number: int, _: object) -> None:
        received[0] = signal.Signals(number)
        warnings.simplefilter("ignore")  # about work that is cut short
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, terminate)
    signal.signal(signal.SIGTERM, terminate)
    try:
        return work() or 0
    except click.UsageError:
        raise
    except expected as error:
        return fail(str(error))
    except BrokenPipeError:  # the reader of standard output has enough, as after `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILURE
    except OSError as error:
        return fail(in_words(error))
    except MemoryError:
        return fail("there is not enough memory: ask for less at once, or close other programs")
    except KeyboardInterrupt:
        print(file=sys.stderr)
        return fail(stopped, 128 + received[0])  # as shells report the end by a signal
    except Exception as error:
        what = " ".join(str(error).split())[:300]
        kept = near(_keep_traceback(folder()))
        sentence = f"internal error: {type(error).__name__}: {what}\nPlease report it, and attach {kept}. {advice}"
        return fail(sentence.rstrip(), DEFECT)


def fail(sentence: str, code: int = FAILURE) -> int:
    """Write a sentence to standard error, with the name of the program, and return the exit code."""
    print(f"{click.get_current_context().find_root().info_name}: {sentence}", file=sys.stderr)
    return code


def near(path: Path) -> str:
    """Return a path as a user can type it in the working directory."""
    here = os.path.relpath(path)
    return shlex.quote(str(path.resolve()) if here.startswith(os.path.join("..", "..")) else here)


def missing_packages(modules: Sequence[str], extra: str) -> str:
    """Return a sentence about modules that aren't installed and the extra that has them; empty if all are there."""
    missing = ", ".join(name for name in modules if not _is_installed(name))
    return f"needs {missing}, which is not installed here: pip install 'shapespace[{extra}]'" if missing else ""


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except (ImportError, ValueError):
        return False


def _imported_late(place: str) -> Callable[..., Any]:
    """Return a function that imports the function MODULE:NAME when it is called."""

    def late(**parameters: Any) -> Any:
        return _imported(place)(**parameters)

    return late


def _imported(place: str) -> Any:
    module, _, name = place.partition(":")
    return getattr(import_module(module), name)


def _one_value_each(arguments: Sequence[str], several: set[str]) -> Iterator[str]:
    """Repeat the names of options with several values: ``--accept A B`` becomes ``--accept A --accept B``."""
    option, values = "", 0
    for each in arguments:
        if each.startswith("-"):
            option, values = (each if each in several else ""), 0
        elif option:
            if values:
                yield option
            values += 1
        yield each


def _refusal(error: click.UsageError) -> str:
    """Return the usage of a command, and a sentence about an argument that is refused."""
    message, context = error.format_message(), error.ctx
    message = message.replace("valid float range", "number").replace("valid integer range", "whole number")
    if context is None or isinstance(error, click.exceptions.NoArgsIsHelpError):
        return message
    advice = context.command.advice if isinstance(context.command, Subcommand) else ""
    ended = message if message.endswith((".", "?")) else f"{message}."
    return f"{context.get_usage()}\n{context.command_path}: error: {ended} {advice}".rstrip()


def _keep_traceback(folder: Path | None) -> Path:
    """Write the traceback of the current exception into a folder, or into a temporary one; return the file's path."""
    for each in (*([folder] if folder else []), Path(tempfile.mkdtemp())):
        path = each / "traceback.txt"
        try:
            path.write_text(traceback.format_exc(), encoding="utf-8")
        except OSError:
            continue
        break
    return path
