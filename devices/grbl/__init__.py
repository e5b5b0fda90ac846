"""A light arm whose motors and lamp hang on a GRBL 1.1 controller."""
