"""Pages that are made from the code: options of programs, messages, drawings, the moving picture, and the site itself."""
