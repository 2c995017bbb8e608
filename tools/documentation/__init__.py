"""What the documentation is made with: its pictures, and the photographs of its tutorial."""
