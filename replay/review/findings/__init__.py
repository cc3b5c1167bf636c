"""The findings of a review, one module each."""
