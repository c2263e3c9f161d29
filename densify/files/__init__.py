# SPDX-License-Identifier: MIT
"""The doors through which every file of others comes in, one for each kind: `content` (bytes),
`texts` (text, JSON, YAML), `arrays` (.npy, .npz), `images` (PNG, JPEG).

Each bounds what a file may cost before it is decoded, believes no size that a header claims, and
turns whatever may be wrong into one InputError that begins with the file's name.
"""
