"""Controllers, one or several alike in a file, around the compiled law of `base.Controller`."""
