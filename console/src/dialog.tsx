// A question before something that can't be taken back, and a notice. Neither is modal: the stop stays within reach.
import { useEffect, useRef } from "preact/hooks";
import { t } from "./i18n/i18n";

interface Props {
  readonly title: string;
  readonly text: string;
  /** What the button says that does it. */
  readonly what: string;
  readonly onYes: () => void;
  readonly onClose: () => void;
}

export function Confirm({ title, text, what, onYes, onClose }: Props): preact.JSX.Element {
  const dialog = useRef<HTMLDialogElement>(null);
  useEffect(() => dialog.current?.show(), []);
  return (
    <dialog ref={dialog} aria-labelledby="confirm-title" aria-describedby="confirm-text" onClose={onClose}
      onKeyDown={(event) => { if (event.key === "Escape") dialog.current?.close(); }}>
      <h2 id="confirm-title">{title}</h2>
      <p id="confirm-text">{text}</p>
      <div class="actions">
        <button onClick={() => dialog.current?.close()}>{t("cancel")}</button>
        <button class="primary" onClick={() => {
          onYes();
          dialog.current?.close();
        }}>{t("confirm", { what })}</button>
      </div>
    </dialog>
  );
}

/** Say what must be read before anything else is done. */
export function Notice({ text, onClose }: Pick<Props, "text" | "onClose">): preact.JSX.Element {
  const dialog = useRef<HTMLDialogElement>(null);
  useEffect(() => dialog.current?.show(), []);
  return (
    <dialog ref={dialog} role="alertdialog" aria-labelledby="notice-text" onClose={onClose}
      onKeyDown={(event) => { if (event.key === "Escape") dialog.current?.close(); }}>
      <p id="notice-text">{text}</p>
      <div class="actions"><button class="primary" onClick={() => dialog.current?.close()}>{t("close")}</button></div>
    </dialog>
  );
}
