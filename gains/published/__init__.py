"""Published designs for comparison: the paper's theorems and earlier observers."""
