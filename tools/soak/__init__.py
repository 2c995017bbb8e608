"""Long runs, and many short ones: does anything grow, slow down or stay behind?"""
