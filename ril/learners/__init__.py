"""The parts that the methods are made of."""
