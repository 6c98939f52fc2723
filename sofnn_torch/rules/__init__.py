"""Rules that people read and edit: words, files, and the command."""
