"""What people see and click: the picker, the viewer, reports, and who may reach them."""
