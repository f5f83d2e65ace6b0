"""What people read: terminal tables, pages, figures."""
