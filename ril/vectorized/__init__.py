"""S independent networks, memories and environments as one: a leading seed axis everywhere."""
