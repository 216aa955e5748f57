"""Its folder is where every test finds `real_slices`."""
