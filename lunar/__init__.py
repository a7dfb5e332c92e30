"""The Moon, its orbiters and the camera: time, frames, gravity, orbits, ephemerides, craters, visibility.

The frames and conventions that every module here follows are on one page in this folder,
``CONVENTIONS.md``. Importing this package does nothing; import the module that is needed.
"""
