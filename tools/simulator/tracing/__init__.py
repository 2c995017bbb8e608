"""Where rays end."""
