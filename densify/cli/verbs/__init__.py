# SPDX-License-Identifier: MIT
"""The verbs, a module each: ``add`` has its options, ``answer`` opens, calls the Python API,
writes, and gives what there is to say. What is heavy is imported when a verb is called, so that
help answers at once."""
