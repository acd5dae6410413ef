"""Controllers: one file each, around the compiled law of `base.Controller`."""
