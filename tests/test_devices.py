"""Training on several devices. The processor is made to look like eight of them, which must be said
before JAX starts; so this file's programs run in a process of their own."""
