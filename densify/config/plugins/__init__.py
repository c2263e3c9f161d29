# SPDX-License-Identifier: MIT
"""The tables of plug-ins: engines of scene flow, readers, outputs,
forms of export.

Rows name modules and import none, so that help and configuration stay light.
"""
