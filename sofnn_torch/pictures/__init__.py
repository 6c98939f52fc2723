"""What a run looks like: figures, films, TensorBoard."""
