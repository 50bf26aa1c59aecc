"""Development tools: campaigns, emulated hardware, generators of documentation."""
