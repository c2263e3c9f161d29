# SPDX-License-Identifier: MIT
"""PandaSet, whose tables are pickles."""
