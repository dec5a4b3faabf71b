"""What every actor is made of: actor loop, bus, clock, mailbox, topics. Knows no robot."""
