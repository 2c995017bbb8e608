"""How good ground truth is: studies on real logs and on simulated sessions."""
