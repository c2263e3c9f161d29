# SPDX-License-Identifier: MIT
"""The .h5 files of OpenSceneFlow: recordings, and sources of flow."""
