// An input whose text belongs to who types, until it counts.
import { useState } from "preact/hooks";

type Input = Event & { readonly currentTarget: HTMLInputElement };

interface InputProps {
  readonly value: string;
  readonly onInput: (event: Input) => void;
  readonly onChange: (event: Input) => void;
  readonly onBlur: () => void;
}

interface Props {
  readonly value: string;
  /** What was typed counts: the field was left, or Enter pressed. */
  readonly onTyped: (input: HTMLInputElement) => void;
  /** Return the input with these. */
  readonly children: (props: InputProps) => preact.JSX.Element;
}

/** Between a key and leaving the field the form may be drawn anew, as when others change something: without this the old
 * value came back, and what was typed was lost. */
export function Typed({ value, onTyped, children }: Props): preact.JSX.Element {
  const [typed, setTyped] = useState<string | null>(null);
  return children({
    value: typed ?? value,
    onInput: (event) => setTyped(event.currentTarget.value),
    onChange: (event) => {
      onTyped(event.currentTarget);
      setTyped(null);
    },
    onBlur: () => setTyped(null),
  });
}
