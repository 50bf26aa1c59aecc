"""The figures of reports and missions by subject, drawn with matplotlib (extra `report`)."""
