"""The findings of a review, a module each."""
