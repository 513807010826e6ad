"""What is known about clips, and what somebody estimated for them, in any layout on disk."""
