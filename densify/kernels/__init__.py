# SPDX-License-Identifier: MIT
"""What is compiled (numba): each module one kind of kernel, plain arrays in and out, no thought of
sweeps or flow. The same input gives the same bytes, whatever the number of threads."""
