"""What calibrating and converting cameras is worth: rendered boards, photographs, conversions."""
