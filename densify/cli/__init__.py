# SPDX-License-Identifier: MIT
"""Run the command line, a thin shell over the Python API. No other package prints."""

from __future__ import annotations

import atexit
import io
import logging
import os
import platform
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from typing import NoReturn, TextIO

from densify.cli.commands import answers, parse
from densify.cli.terminal import Screen, screen
from densify.config.errors import ComputationError, InputError, is_out_of_memory
from densify.pipeline.process import keep_freed_memory
from densify.version import __version__

# FAILED: computation or bug (traceback in a file); BAD_INPUT: arguments, input, system errors
DONE, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: DONE, FAILED, BAD_INPUT or INTERRUPTED."""
    with screen() as shown:
        try:
            _run(arguments, shown)
            return shown.end(DONE)
        except InputError as error:
            return shown.end(BAD_INPUT, str(error))
        except ComputationError as error:
            return shown.end(FAILED, str(error))
        except KeyboardInterrupt:
            return shown.end(INTERRUPTED, "interrupted; what was unfinished is not kept")
        except BrokenPipeError:
            _let_go_of(sys.stdout)  # its reader has closed it
            return DONE
        except OSError as error:
            _let_go_of(sys.stdout)
            where = error.filename or "stdout"
            return shown.end(BAD_INPUT, f"{where}: {error.strerror or error}")
        except Exception as error:
            if is_out_of_memory(error):
                advice = "try a smaller --window, fewer --workers or one --camera"
                return shown.end(FAILED, f"out of memory; {advice}")
            log = _write_bug_report(error)
            return shown.end(
                FAILED, f"this is a bug in densify; please report it with the log at {log}"
            )


def script() -> NoReturn:
    """Run `main` as the process's entry point: the console script and ``python -m densify``."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # Characters that the terminal's encoding lacks
            stream.reconfigure(errors="backslashreplace")
    # Work is shared among our own threads. Those of OpenBLAS would wait in busy loops.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    keep_freed_memory()
    logging.getLogger("densify.progress").setLevel(logging.INFO)
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) == signal.SIG_DFL:  # nohup has it ignored
            signal.signal(number, signal.default_int_handler)
    code: int | None = None
    # The last function called at exit, because Python would collect garbage for half
    # a second after a run.
    atexit.register(lambda: None if code is None else os._exit(code))
    code = main()
    for stream in (sys.stdout, sys.stderr):
        _let_go_of(stream)
    if code == INTERRUPTED:
        os._exit(code)  # Python would wait for threads at work
    sys.exit(code)


def _run(arguments: Sequence[str] | None, shown: Screen) -> None:
    try:
        options = parse(arguments)
    except SystemExit:  # help, version or a bad argument; a closed stdout shows only on flushing
        sys.stdout.flush()
        raise
    shown.begin(options)
    for answer in answers(options):
        shown.show(answer)


def _let_go_of(stream: TextIO) -> None:
    """Redirect a broken output stream, which the interpreter would flush at exit."""
    try:
        stream.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _write_bug_report(error: BaseException) -> str:
    """Write versions, command and traceback to a temporary file, and return its path."""
    prefix = time.strftime("densify-bug-%Y%m%d-%H%M%S-")
    number, path = tempfile.mkstemp(".log", prefix)
    with open(number, "w", encoding="utf-8", errors="backslashreplace") as file:
        print("densify", __version__, platform.python_version(), platform.platform(), file=file)
        print("command:", sys.argv, file=file)
        traceback.print_exception(error, file=file)
    return path
