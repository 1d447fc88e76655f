"""S independent networks, memories and environments as one: every array has a leading seed axis."""
