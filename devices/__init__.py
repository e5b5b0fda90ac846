"""Devices: interfaces of camera, projector and light arm, and what fills them."""
