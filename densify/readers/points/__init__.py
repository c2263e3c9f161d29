# SPDX-License-Identifier: MIT
"""Files of points in any of the usual formats, and what their columns mean."""
