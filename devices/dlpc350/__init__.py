"""TI's DLPC350 projector controller (LightCrafter 4500) over USB."""
