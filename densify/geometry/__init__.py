# SPDX-License-Identifier: MIT
"""Provide poses, camera models, nearest neighbours and the types that stages hand on."""
