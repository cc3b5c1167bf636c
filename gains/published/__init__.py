"""What others published: the paper's theorems and earlier observers, to compare with."""
