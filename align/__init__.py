"""In-flight alignment: error-state filters on delayed fixes, their bound and their consistency."""
