"""What is allowed: the rules, and the flying once one has fired."""
