# SPDX-License-Identifier: MIT
"""What can be added to densify, a table each: engines of scene flow, readers, outputs,
forms of export.

Rows name modules and import none, so that help and configuration stay light.
"""
