# SPDX-License-Identifier: MIT
"""Scene flow between point clouds. Import its modules: the package itself loads nothing."""
