"""Points from depth images, contacts and motions."""
