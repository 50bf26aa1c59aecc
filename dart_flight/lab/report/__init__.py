"""HTML pages of flights, campaigns and inspections, and their figures."""
