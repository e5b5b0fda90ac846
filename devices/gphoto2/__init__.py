"""Tethered DSLR and mirrorless cameras through libgphoto2, their raw files through LibRaw."""
