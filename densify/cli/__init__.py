# SPDX-License-Identifier: MIT
"""The command line: a thin shell over the Python API.

Results and paths go to stdout, progress and log to stderr. Only this package prints. Modules that
load numpy and heavier things are imported by the verb that needs them, so that help is instant.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from densify.cli.arguments import parse
from densify.cli.screen import logging_to_stderr
from densify.errors import ComputationError, InputError

DONE, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    0 done; 1 a ComputationError; 2 an InputError (argparse exits with 2 as well); 130 interrupted.
    Anything else is a bug and keeps its traceback.
    """
    with logging_to_stderr() as log:
        try:
            _run(arguments)
        except InputError as error:
            log.error("%s", error)
            return BAD_INPUT
        except ComputationError as error:
            log.error("%s", error)
            return FAILED
        except KeyboardInterrupt:
            log.error("interrupted; nothing was kept of the unfinished result")
            return INTERRUPTED
        except BrokenPipeError:
            # The reader of stdout has seen enough; keep the interpreter from flushing into it.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return DONE


def script() -> NoReturn:
    """`main` as a process of its own: the console script and ``python -m densify``."""
    # Work is shared out among our own threads; OpenBLAS's would wait beside them in busy loops.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    code = main()
    if code == INTERRUPTED:
        # Python dies of the signal, not with 130, where an extension module was being imported,
        # and waits for threads that are at work.
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def _run(arguments: Sequence[str] | None) -> None:
    try:
        options = parse(arguments)
    except SystemExit:  # help, version or a bad argument; a closed stdout shows only on flushing
        sys.stdout.flush()
        raise
    options.verb(options)
    sys.stdout.flush()
