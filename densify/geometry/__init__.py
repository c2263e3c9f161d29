# SPDX-License-Identifier: MIT
"""Where things are: poses, camera models, what a sweep saw in every direction, the ground."""
