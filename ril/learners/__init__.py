"""The parts that the methods are made of: what is trained, how it explores, when it stops."""
