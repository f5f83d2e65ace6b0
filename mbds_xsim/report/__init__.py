"""Reports for people: terminal tables, pages, figures."""
